"""A covariance that carries its names; how it comes about: `model_`, `stated_covariance`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphs.frames import FloatArray

POSE_NAMES = (
    *(f"rotation_{axis}" for axis in "xyz"),
    *(f"translation_{axis}" for axis in "xyz"),
)


@dataclass(frozen=True)
class Covariance:
    """A covariance that carries its names: `camera.fx`, `camera.rotation_x` (rad), ..."""

    names: tuple[str, ...]
    matrix: FloatArray  # (n, n)

    @property
    def sigma(self) -> dict[str, float]:
        variances = np.maximum(np.diag(self.matrix), 0.0)  # an exact zero may round below
        return dict(zip(self.names, np.sqrt(variances).tolist(), strict=True))

    def of_difference(self, a: str, b: str) -> float:
        """Sigma of parameter `a` minus parameter `b`; one that is not here has none."""
        weights = np.array([(name == a) - (name == b) for name in self.names], dtype=np.float64)
        variance = float(weights @ self.matrix @ weights)
        return max(variance, 0.0) ** 0.5


NOTHING = Covariance((), np.zeros((0, 0)))  # of what is exactly known, or states no sigmas
