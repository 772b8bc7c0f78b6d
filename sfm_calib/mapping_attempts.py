"""From which pairs of images the incremental mapper starts, one try after the other."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MappingAttempt:
    """How one run of the incremental mapper is started."""

    seed: int
    min_start_angle_deg: float
    max_start_forward: float


def attempts(seed: int) -> list[MappingAttempt]:
    """COLMAP's own start first, then gentler ones: 2 of 82 images was seen with an unlucky one."""
    return [
        MappingAttempt(seed, 16.0, 0.95),
        MappingAttempt(seed + 1, 8.0, 0.99),
        MappingAttempt(seed + 2, 4.0, 1.0),
    ]
