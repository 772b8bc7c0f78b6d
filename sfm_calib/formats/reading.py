"""What a file says of cameras and how they sit, in one form whatever the format."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np

from graphs.camera import Camera
from graphs.covariance import Covariance
from graphs.frames import FloatArray, Transform
from graphs.lenses import PARAMETER_NAMES, LensName
from sfm_calib.errors import CalibrationError
from sfm_calib.result import Calibration, CameraResult, CamFromRig, RigResult, Scale

# m; the longest baseline, 1 long; or whatever the file's author counted in, and did not say.
LengthUnit = Literal["m", "baseline", "unknown"]
NO_SIZE: Final = (0, 0)  # of an image whose size the file does not state
NOTHING: Final = Covariance((), np.zeros((0, 0)))
MOST_SKEW_PX = 1e-6  # of a camera matrix: rounding
MOST_UNROTATION = 1e-3  # of R R' off the identity: typed with three digits
OPENCV_LENSES: dict[int, LensName] = {
    0: "pinhole", 4: "radtan", 5: "brown", 8: "rational", 12: "thin_prism", 14: "thin_prism",
}  # fmt: skip


@dataclass(frozen=True)
class CameraRig:
    """A calibration as it was read."""

    path: Path
    format: str  # in words, with what had to be converted
    cameras: tuple[Camera, ...]  # pixel centres at integers; size NO_SIZE where not stated
    cam_from_rig: tuple[Transform, ...] | None  # None: the file does not say how they sit
    unit: LengthUnit = "unknown"
    covariance: Covariance = NOTHING  # no names: the file states no sigmas
    notes: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(camera.name for camera in self.cameras)

    @property
    def states_sigmas(self) -> bool:
        return bool(np.diag(self.covariance.matrix).any())

    def calibration(self) -> Calibration:
        """As a result, the first camera its reference.

        Raises CalibrationError where the file does not say how its cameras sit, or how large
        their images are.
        """
        if self.cam_from_rig is None:
            raise CalibrationError(
                f"{self.path} does not say how its {len(self.cameras)} cameras sit: give a file "
                "that holds the rig too"
            )
        for camera in self.cameras:
            if camera.size == NO_SIZE:
                raise CalibrationError(
                    f"{self.path} does not state the image size of {camera.name}: add it"
                )
        rig_from_first = self.cam_from_rig[0].inverse
        placed = [t @ rig_from_first for t in self.cam_from_rig]
        return Calibration(
            cameras={
                c.name: CameraResult(lens=c.lens, size=c.size, params=c.named())
                for c in self.cameras
            },
            rig=RigResult(
                reference=self.cameras[0].name,
                cam_from_rig={
                    c.name: CamFromRig(
                        rotation_wxyz=tuple(t.rotation_wxyz.tolist()),
                        translation=tuple(t.translation.tolist()),
                    )
                    for c, t in zip(self.cameras, placed, strict=True)
                },
                metric=self.unit == "m",
                scale=Scale(source=self.format),
            ),
        )

    def metric(self, metres: float) -> CameraRig:
        """The same, its unit of length being so many metres."""
        if self.cam_from_rig is None:
            return self
        by = np.array([metres if ".translation_" in n else 1.0 for n in self.covariance.names])
        matrix = self.covariance.matrix * by[:, None] * by
        return replace(
            self,
            cam_from_rig=tuple(t.scaled(metres) for t in self.cam_from_rig),
            covariance=Covariance(self.covariance.names, matrix),
            unit="m",
        )


def opencv_camera(
    name: str,
    size: tuple[int, int],
    matrix: Sequence[Sequence[float]] | FloatArray,
    distortion: Sequence[float] | FloatArray,
    fisheye: bool = False,
) -> Camera:
    """A camera of OpenCV's camera matrix (3, 3) and 0, 4, 5, 8, 12 or 14 distortion coefficients.

    fisheye: the 4 coefficients are of OpenCV's fisheye module, ROS's and Kalibr's equidistant.
    Raises CalibrationError for a skewed or impossible matrix, and for any other count.
    """
    K = np.asarray(matrix, dtype=np.float64)
    k = np.asarray(distortion, dtype=np.float64).ravel()
    if K.shape != (3, 3) or not np.isfinite(K).all() or not np.isfinite(k).all():
        raise CalibrationError(f"{name}: its camera matrix is no 3 x 3 matrix of numbers")
    if abs(K[0, 1]) > MOST_SKEW_PX:
        raise CalibrationError(
            f"{name}: its camera matrix has a skew of {K[0, 1]:.6g} px, which no lens here has: "
            "calibrate it without skew"
        )
    if not (K[0, 0] > 0 and K[1, 1] > 0) or not np.allclose(K[2], [0, 0, 1]):
        raise CalibrationError(
            f"{name}: its camera matrix has focal lengths {K[0, 0]:.6g} and {K[1, 1]:.6g}: both "
            "must be positive, and its last row 0 0 1"
        )
    if k.size not in OPENCV_LENSES or (fisheye and k.size != 4):
        raise CalibrationError(
            f"{name}: {k.size} distortion coefficients; OpenCV has 4, 5, 8, 12 or 14, and 4 of a "
            "fisheye"
        )
    if k.size == 14 and k[12:].any():
        raise CalibrationError(
            f"{name}: its sensor is tilted (tauX {k[12]:.3g}, tauY {k[13]:.3g}), which no lens "
            "here has: calibrate it without CALIB_TILTED_MODEL"
        )
    lens: LensName = "kannala_brandt" if fisheye else OPENCV_LENSES[k.size]
    params = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *k[:12]])
    return Camera(name, lens, size, params[: len(PARAMETER_NAMES[lens])])


def transform(name: str, rotation: object, translation: object) -> Transform:
    """From a rotation matrix (3, 3), or a rotation vector (3,), and a translation (3,).

    Raises CalibrationError where they are neither.
    """
    R = np.asarray(rotation, dtype=np.float64)
    t = np.asarray(translation, dtype=np.float64).ravel()
    if R.size == 3 and t.size == 3 and np.isfinite([*R.ravel(), *t]).all():
        return Transform.exp(R.ravel(), t)
    if R.shape != (3, 3) or t.size != 3 or not np.isfinite([*R.ravel(), *t]).all():
        raise CalibrationError(f"{name}: its rotation must be a 3 x 3 matrix, its translation 3")
    off = float(np.abs(R @ R.T - np.eye(3)).max())
    if off > MOST_UNROTATION or np.linalg.det(R) < 0:
        raise CalibrationError(
            f"{name}: its rotation matrix is none (R R' differs from the identity by {off:.2g}, "
            f"determinant {np.linalg.det(R):.3g}): check the file"
        )
    u, _, vt = np.linalg.svd(R)  # the nearest rotation: files round
    return Transform(u @ vt, t)
