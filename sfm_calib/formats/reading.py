"""What a file says of cameras and how they sit, in one form whatever the format."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

import numpy as np

from graphs.camera import Camera
from graphs.compare import Stated
from graphs.covariance import NOTHING, Covariance
from graphs.frames import FloatArray, Transform
from graphs.lenses import PARAMETER_NAMES, LensName
from graphs.pose_covariance import rereferenced
from graphs.problem import Estimate
from sfm_calib import result
from sfm_calib.errors import CalibrationError, nearest
from sfm_calib.result import Calibration, CameraResult, CamFromRig, RigResult, Scale

# m; the longest baseline, 1 long; or whatever the file's author counted in, and did not say.
LengthUnit = Literal["m", "baseline", "unknown"]
NO_SIZE: Final = (0, 0)  # of an image whose size the file does not state
MOST_SIZE = 100_000  # px across: five times the largest sensor there is
MOST_NUMBER = 1e9  # beyond, it is no focal length, coefficient or distance
MOST_NAME = 200  # characters of a camera's name: file systems end at 255
MOST_CAMERAS = 1000
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
    n_frames: int | None = None  # that the covariance rests on; None: not stated

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(camera.name for camera in self.cameras)

    @property
    def states_sigmas(self) -> bool:
        return bool(np.diag(self.covariance.matrix).any())

    @property
    def stated(self) -> Stated:
        """For the maths; cameras that sit nowhere sit in one place."""
        placed = self.cam_from_rig or (Transform.identity(),) * len(self.cameras)
        return Stated(Estimate(self.cameras, placed, (), np.zeros((0, 3))), self.covariance)

    def checked(self) -> CameraRig:
        """Itself. Raises CalibrationError for names, sizes and numbers that no camera has."""
        names = self.names
        if not 0 < len(names) <= MOST_CAMERAS:
            raise CalibrationError(f"{self.path} holds {len(names)} cameras: it is no calibration")
        for name in names:
            if not name.strip() or len(name) > MOST_NAME or not name.isprintable():
                raise CalibrationError(f"{self.path}: {name[:40]!r} is no name for a camera")
            if names.count(name) > 1:
                raise CalibrationError(f"{self.path} calls two cameras {name}: name them apart")
        for camera in self.cameras:
            if camera.size != NO_SIZE and not 0 < min(camera.size) <= max(camera.size) <= MOST_SIZE:
                raise _no_size(camera.name, *camera.size)
            if not camera.params[:2].min() > 0:
                raise CalibrationError(
                    f"{self.path}: {camera.name} has focal lengths {camera.params[0]:.6g} and "
                    f"{camera.params[1]:.6g}: both must be positive"
                )
        if any(t.translation.shape != (3,) for t in self.cam_from_rig or ()):
            raise CalibrationError(f"{self.path}: a camera's place is not whole")
        numbers = [c.params for c in self.cameras] + [
            t.translation for t in self.cam_from_rig or ()
        ]
        if not (np.abs(np.concatenate(numbers)) < MOST_NUMBER).all():
            raise CalibrationError(
                f"{self.path} holds a number beyond {MOST_NUMBER:.0g}, or none at all: it is no "
                "calibration"
            )
        return self

    def only(self, names: Sequence[str]) -> CameraRig:
        """The same with these cameras alone, in this order.

        Raises CalibrationError for a camera that is not there, or twice.
        """
        for name in names:
            if name not in self.names:
                raise CalibrationError(
                    f"{self.path} has no camera {name!r}: {nearest(name, self.names)}"
                )
        if len(set(names)) < len(names):
            raise CalibrationError(f"{' '.join(names)} names a camera twice")
        places = [self.names.index(name) for name in names]
        rig = self.cam_from_rig
        kept = [i for i, n in enumerate(self.covariance.names) if n.rpartition(".")[0] in names]
        return replace(
            self,
            cameras=tuple(self.cameras[i] for i in places),
            cam_from_rig=None if rig is None else tuple(rig[i] for i in places),
            covariance=Covariance(
                tuple(self.covariance.names[i] for i in kept),
                self.covariance.matrix[np.ix_(kept, kept)],
            ),
        )

    def referenced(self) -> tuple[CameraRig, int]:
        """The rig in the frame of one of its cameras, the first that is there or else the first.

        With its covariance; and which camera that is. `cam_from_rig` must be known.
        """
        assert self.cam_from_rig is not None
        rig = self.cam_from_rig
        at_origin = [
            i
            for i, t in enumerate(rig)
            if not t.translation.any() and np.array_equal(t.rotation, np.eye(3))
        ]
        if at_origin:
            return self, at_origin[0]
        new, covariance = rereferenced(self.stated.estimate, self.covariance, 0)
        return replace(self, cam_from_rig=new.cam_from_rig, covariance=covariance), 0

    def calibration(self) -> Calibration:
        """As a result, with the sigmas that it states; reference as `referenced`.

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
        rig, reference = self.referenced()
        return Calibration(
            cameras={c.name: rig._camera_result(c) for c in rig.cameras},
            rig=RigResult(
                reference=rig.names[reference],
                cam_from_rig={name: rig._place(i) for i, name in enumerate(rig.names)},
                metric=self.unit == "m",
                scale=Scale(source=self.format),
            ),
            covariance=result.Covariance(
                names=rig.covariance.names,
                matrix=tuple(tuple(row) for row in rig.covariance.matrix.tolist()),
            ),
        )

    def _camera_result(self, camera: Camera) -> CameraResult:
        sigma = self.covariance.sigma if self.covariance.names else {}
        told = {n: sigma.get(f"{camera.name}.{n}", 0.0) for n in camera.names} if sigma else {}
        return CameraResult(lens=camera.lens, size=camera.size, params=camera.named(), sigma=told)

    def _place(self, index: int) -> CamFromRig:
        assert self.cam_from_rig is not None
        return CamFromRig.of(self.names[index], self.cam_from_rig[index], self.covariance.sigma)

    def metric(self, metres: float) -> CameraRig:
        """The same, its unit of length being so many metres."""
        if self.cam_from_rig is None:
            return self
        side = self.stated.scaled(metres)
        placed = side.estimate.cam_from_rig
        return replace(self, cam_from_rig=placed, covariance=side.covariance, unit="m")


def image_size(name: str, width: object, height: object) -> tuple[int, int]:
    """Of numbers or their texts; NO_SIZE of two zeros. Raises CalibrationError for no such size."""
    try:
        pair = float(str(width)), float(str(height))
        if pair == NO_SIZE or all(0 < n <= MOST_SIZE and n == int(n) for n in pair):
            return int(pair[0]), int(pair[1])
    except (ValueError, OverflowError):
        pass
    raise _no_size(name, width, height)


def _no_size(name: str, width: object, height: object) -> CalibrationError:
    return CalibrationError(
        f"{name}: its images are {str(width)[:20]} x {str(height)[:20]} px: each must be a whole "
        f"number from 1 to {MOST_SIZE}"
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
    if K.shape != (3, 3) or not _are_sane(K, k):
        raise CalibrationError(
            f"{name}: its camera matrix must be 3 x 3, and it and its distortion be numbers below "
            f"{MOST_NUMBER:.0g}"
        )
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
    if R.size == 3 and t.size == 3 and _are_sane(R, t):
        return Transform.exp(R.ravel(), t)
    if R.shape != (3, 3) or t.size != 3 or not _are_sane(R, t):
        raise CalibrationError(
            f"{name}: its rotation must be a 3 x 3 matrix and its translation 3, of numbers below "
            f"{MOST_NUMBER:.0g}"
        )
    off = float(np.abs(R @ R.T - np.eye(3)).max())
    if off > MOST_UNROTATION or np.linalg.det(R) < 0:
        raise CalibrationError(
            f"{name}: its rotation matrix is none (R R' differs from the identity by {off:.2g}, "
            f"determinant {np.linalg.det(R):.3g}): check the file"
        )
    u, _, vt = np.linalg.svd(R)  # the nearest rotation: files round
    return Transform(u @ vt, t)


def _are_sane(*arrays: FloatArray) -> bool:
    """Whether all are finite, and of a size whose squares are."""
    return all(bool((np.abs(a) < MOST_NUMBER).all()) for a in arrays)
