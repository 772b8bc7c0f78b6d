"""The first guess at a lens from views of a flat board: nothing need be known but the image size.

Perspective and equidistant cameras of many focal lengths each place the board in every view; how
well they can tells the family and the focal length. The best of each family is then refined with
its principal point, two coefficients and all boards together, and the better one is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from graphs.camera import Camera, fit_lens, nominal_params, project_jacobian, unproject
from graphs.frames import FloatArray
from graphs.lenses import LENSES, IntArray, LensName
from graphs.planar import (
    Corners,
    Scene,
    Transforms,
    damped_solve,
    fit,
    jacobians,
    linear_transforms,
    moved,
    residuals,
    rms_px,
    solve_views,
)

LensChoice = LensName | Literal["auto"]
FAMILIES: tuple[LensName, LensName] = ("radial", "kannala_brandt")  # perspective, equidistant
# Fields of view in degrees over the longer side, and how many focal lengths span them: steps of
# 17 and 12 %, over which the error's valley is still seen. Below 50 degrees the families agree.
FIELDS_DEG: dict[LensName, tuple[float, float, int]] = {
    "radial": (15.0, 150.0, 22),
    "kannala_brandt": (50.0, 230.0, 14),
}
SWEEP_ITERATIONS = 5
REFINE_ITERATIONS = 40
PLACED_ANEW = 3  # times at most
BADLY_PLACED = 1.5  # times the median rms: the board may be in a wrong place
WIDEST_DEG = 75.0  # off axis, beyond which no lens on a plane is fitted
# Soft knowledge, so that what the views leave open stays sane: the focal length in image widths,
# its factor; the principal point from the centre in image widths; the distortion at the corner.
FOCAL_WIDTHS, FOCAL_FACTOR = 1.0, 2.0
CENTRE_WIDTHS = 0.05  # corridor_stereo's right camera: 0.06; most are below 0.03
DISTORTION = 0.5
SMALLEST_RMS_PX = 0.05  # of a view; drawn corners are better, but no lens of two coefficients is
OUTLYING = 3.0  # times the median: a view's weight falls to a quarter there
# A fisheye lens fits a perspective image nearly as well; the plainer one unless it is 10 % worse.
CLEARLY_BETTER = 0.1
# Relative sigma of the focal length. Frontal views alone leave 0.2 to 0.7, three tilted ones 0.005
# to 0.02.
WEAK_FOCAL = 0.05


@dataclass(frozen=True)
class LensStart:
    """A camera to start from, and how well the views determine it."""

    camera: Camera
    rms_px: float  # median over the views
    focal_sigma: float  # relative, of noise alone; zero of a camera that was given
    weak: bool  # the views hardly determine the focal length


def start_lens(name: str, size: tuple[int, int], corners: Corners, lens: LensChoice) -> LensStart:
    """Lens of one camera from some of its views, 40 diverse ones at most for speed.

    corners: of that camera's views alone. lens: the result's; "auto" gives a `radial` or a
    `kannala_brandt`, whichever the views fit.
    """
    corners = replace(corners, camera=np.zeros(len(corners.camera), dtype=np.int64))
    found = {family: _refined(*_sweep(name, size, corners, family), corners) for family in FAMILIES}
    for family, other in zip(FAMILIES, FAMILIES[::-1], strict=True):
        # Strong distortion misleads a family's sweep, or its refinement ends in another valley.
        again = _refined(_translated(found[other].camera, family, corners), None, corners)
        found[family] = min(found[family], again, key=lambda each: _score(corners, each.rms_px))
    best = _chosen(found, corners) if lens == "auto" else found[FAMILIES[int(LENSES[lens].wide)]]
    camera = best.camera if lens == "auto" else _as_lens(best.camera, lens)
    weak = bool(best.focal_sigma > WEAK_FOCAL)
    return LensStart(camera, float(np.median(best.rms_px)), best.focal_sigma, weak)


def _as_lens(camera: Camera, lens: LensName) -> Camera:
    if lens == camera.lens:
        return camera
    return fit_lens(camera, lens, set(LENSES[lens].coefficients) & {"k1", "k2", "alpha", "xi"})[0]


def _chosen(found: dict[LensName, _Refined], corners: Corners) -> _Refined:
    plain, wide = (found[family] for family in FAMILIES)
    scores = _scores(corners, np.stack([plain.rms_px, wide.rms_px]))
    return wide if scores[1] < scores[0] - CLEARLY_BETTER * len(corners.view) else plain


def _translated(camera: Camera, family: LensName, corners: Corners) -> Camera:
    """The camera of the other family that is nearest where the corners are: linear least squares
    of pixel radii by odd powers of the angle, or of its tangent."""
    rays = unproject(camera, corners.pixels)
    with np.errstate(invalid="ignore"):
        angle = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
        seen = angle < (np.pi if LENSES[family].wide else np.radians(WIDEST_DEG))
    radius_px = np.linalg.norm(corners.pixels - camera.params[2:4], axis=1)[seen]
    radius = angle[seen] if LENSES[family].wide else np.tan(angle[seen])
    design = radius[:, None] ** np.array([1, 3, 5])
    size = np.maximum(np.linalg.norm(design, axis=0), 1e-12)
    terms = np.linalg.lstsq(design / size, radius_px, rcond=1e-6)[0] / size
    if not terms[0] > 0:
        terms = np.array([camera.params[0], 0.0, 0.0])
    params = nominal_params(family, camera.size, float(terms[0]))
    params[2:4], params[4:6] = camera.params[2:4], terms[1:] / terms[0]
    return replace(camera, lens=family, params=params)


def _score(corners: Corners, rms: FloatArray) -> float:
    """Log of the error, views far worse than the rest counting little."""
    return float(np.log(np.maximum(rms, SMALLEST_RMS_PX)) @ corners.counts)


def _scores(corners: Corners, rms: FloatArray) -> FloatArray:
    """How badly candidates fit (m,), from the rms of their views (m, n_views); robustly.

    The logarithm bounds what a mis-detected view can say, and compares tilted views, which tell
    lenses apart, on the scale of the best candidate's error.
    """
    scale = max(float(np.median(rms, axis=1).min()), SMALLEST_RMS_PX)
    score: FloatArray = np.log1p((rms / scale) ** 2) @ corners.counts
    return score


def _sweep(
    name: str, size: tuple[int, int], corners: Corners, family: LensName
) -> tuple[Camera, Transforms]:
    """The focal length under which the boards of all views fit best, and where they are then."""
    low, high, count = FIELDS_DEG[family]
    wide = LENSES[family].wide
    half = np.radians(np.array([low, high])) / 2
    ends = max(size) / 2 / (half if wide else np.tan(half))
    cameras, boards, rms = [], [], []
    for focal_px in np.geomspace(ends[0], ends[1], count):
        camera = Camera(name, family, size, nominal_params(family, size, focal_px))
        start = linear_transforms(corners, _undistorted_rays(camera, corners.pixels, wide))
        scene = Scene.of_lone_views([camera], corners)
        placed, error = fit(scene, start, SWEEP_ITERATIONS)
        cameras.append(camera)
        boards.append(placed)
        rms.append(error)
    scores = _scores(corners, np.array(rms))
    focal_px = np.array([camera.params[0] for camera in cameras])
    # Frontal views fit any focal length: a doubling of the usual one costs as one sigma does.
    scores += (np.log(focal_px / (FOCAL_WIDTHS * max(size))) / np.log(FOCAL_FACTOR)) ** 2
    best = int(np.argmin(scores))
    return cameras[best], boards[best]


def _undistorted_rays(camera: Camera, pixels: FloatArray, wide: bool) -> FloatArray:
    off = (pixels - camera.params[2:4]) / camera.params[:2]
    radius = np.linalg.norm(off, axis=1, keepdims=True)
    angle = np.minimum(radius, np.pi) if wide else np.arctan(radius)
    return np.concatenate([off / np.maximum(radius, 1e-12) * np.sin(angle), np.cos(angle)], axis=1)


# ---- lens and boards together ----------------------------------------------------------------


@dataclass(frozen=True)
class _Refined:
    camera: Camera
    boards: Transforms  # cam_from_board of each view
    rms_px: FloatArray  # (n_views,)
    focal_sigma: float  # relative


def _refined(start: Camera, boards: Transforms | None, corners: Corners) -> _Refined:
    """Lens and boards together; again while boards placed anew, or turned over, fit better."""
    if boards is None:
        boards = solve_views([start], corners).first
    result = _refine(start, boards, corners)
    for _ in range(PLACED_ANEW):
        better = _placed_anew(result, corners)
        if better is None:
            break
        result = _refine(result.camera, better, corners)
    return result


def _placed_anew(result: _Refined, corners: Corners) -> Transforms | None:
    """Boards where another place fits better, sought for those that fit badly; None: nowhere."""
    camera, rms, boards = result.camera, result.rms_px, result.boards
    bad = np.flatnonzero(rms > BADLY_PLACED * max(float(np.median(rms)), SMALLEST_RMS_PX))
    both = solve_views([camera], corners, boards)
    better, found = both.first_rms_px, both.first
    if bad.size:
        anew = solve_views([camera], corners.of_views(bad))
        nearer = np.zeros(len(rms), dtype=bool)
        nearer[bad] = anew.first_rms_px < better[bad]
        rotation, translation = found.rotation.copy(), found.translation.copy()
        of_bad = nearer[bad]
        rotation[nearer] = anew.first.rotation[of_bad]
        translation[nearer] = anew.first.translation[of_bad]
        found = Transforms(rotation, translation)
        better = better.copy()
        better[nearer] = anew.first_rms_px[of_bad]
    return found if np.any(better < 0.99 * rms) else None


@dataclass(frozen=True)
class _Soft:
    """Gaussian knowledge of log focal length, cx, cy, k1, k2."""

    mean: FloatArray  # (5,)
    sigma: FloatArray  # (5,)

    @staticmethod
    def of(camera: Camera) -> _Soft:
        width = max(camera.size)
        corner = float(np.hypot(*camera.size)) / 2 / camera.params[0]
        if LENSES[camera.lens].wide:
            corner = min(corner, np.pi / 2)
        return _Soft(
            np.array([np.log(FOCAL_WIDTHS * width), *camera.centre, 0.0, 0.0]),
            np.array([
                np.log(FOCAL_FACTOR), *(CENTRE_WIDTHS * width,) * 2,
                DISTORTION / corner**2, DISTORTION / corner**4,
            ]),
        )  # fmt: skip


def _values(camera: Camera) -> FloatArray:
    return np.array([np.log(camera.params[0]), *camera.params[2:6]])


def _with_values(camera: Camera, values: FloatArray) -> Camera:
    params = camera.params.copy()
    params[:2] = np.exp(values[0])
    params[2:6] = values[1:]
    return replace(camera, params=params)


@dataclass(frozen=True)
class _Normal:
    """Normal equations of lens and boards: the lens's block, the boards', and between."""

    lens: FloatArray  # (5, 5)
    lens_slope: FloatArray  # (5,)
    boards: FloatArray  # (v, 6, 6)
    boards_slope: FloatArray  # (v, 6)
    between: FloatArray  # (v, 5, 6)

    def step(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """Steps of the lens (5,) and the boards (v, 6) by the Schur complement."""
        dampings = np.full(len(self.boards), damping)
        gain = np.stack(
            [damped_solve(self.boards, self.between[:, i], dampings) for i in range(5)], axis=1
        )  # (v, 5, 6)
        square = self.lens * (1 + damping * np.eye(5)) - np.einsum(
            "vik,vjk->ij", gain, self.between
        )
        slope = self.lens_slope - np.einsum("vik,vk->i", gain, self.boards_slope)
        lens = -np.linalg.solve(square, slope)
        right = self.boards_slope + np.einsum("vik,i->vk", self.between, lens)
        return lens, -damped_solve(self.boards, right, dampings)

    def lens_covariance(self) -> FloatArray:
        undamped = np.zeros(len(self.boards))
        gain = [damped_solve(self.boards, self.between[:, i], undamped) for i in range(5)]
        square = self.lens - np.einsum("ivk,vjk->ij", np.array(gain), self.between)
        return np.linalg.inv(square)


def _normal(
    camera: Camera, boards: Transforms, corners: Corners, soft: _Soft, weight: FloatArray
) -> _Normal:
    """weight (n,): of each corner's squared error, relative to the noise."""
    scene = Scene.of_lone_views([camera], corners)
    error, by_point, turned = residuals(scene, boards)
    points = turned + boards.translation[corners.view]
    by_params = project_jacobian(camera, points)[2]
    by_focal = camera.params[0] * (by_params[..., 0] + by_params[..., 1])
    by_lens = np.concatenate([by_focal[..., None], by_params[..., 2:6]], axis=2)
    by_board = jacobians(by_point, turned)
    lens_weighted, board_weighted = (weight[:, None, None] * each for each in (by_lens, by_board))
    off = (_values(camera) - soft.mean) / soft.sigma**2
    return _Normal(
        np.einsum("nki,nkj->ij", lens_weighted, by_lens) + np.diag(soft.sigma**-2),
        np.einsum("nki,nk->i", lens_weighted, error) + off,
        corners.sums(np.einsum("nki,nkj->nij", board_weighted, by_board)),
        corners.sums(np.einsum("nki,nk->ni", board_weighted, error)),
        corners.sums(np.einsum("nki,nkj->nij", lens_weighted, by_board)),
    )


def _view_weights(corners: Corners, rms: FloatArray) -> FloatArray:
    """Weight of each corner (n,): views far worse than the median hardly count."""
    noise = max(float(np.median(rms)), SMALLEST_RMS_PX)
    outlying = (rms / (OUTLYING * noise)) ** 2
    by_view = 2.0 / noise**2 / (1 + outlying) ** 2  # rms is of two coordinates
    weight: FloatArray = corners.weight * by_view[corners.view]
    return weight


def _cost(
    camera: Camera, boards: Transforms, corners: Corners, soft: _Soft, weight: FloatArray
) -> tuple[float, FloatArray]:
    error = residuals(Scene.of_lone_views([camera], corners), boards)[0]
    off = (_values(camera) - soft.mean) / soft.sigma
    return float(weight @ (error**2).sum(1) + off @ off), rms_px(corners, error)


def _refine(camera: Camera, boards: Transforms, corners: Corners) -> _Refined:
    soft, damping = _Soft.of(camera), 1e-3
    error = residuals(Scene.of_lone_views([camera], corners), boards)[0]
    rms = rms_px(corners, error)
    for _ in range(REFINE_ITERATIONS):
        weight = _view_weights(corners, rms)
        before, _ = _cost(camera, boards, corners, soft, weight)
        normal = _normal(camera, boards, corners, soft, weight)
        fall = 0.0
        while damping < 1e6:
            lens_step, board_step = normal.step(damping)
            tried = _with_values(camera, _values(camera) + np.clip(lens_step, -1e4, 1e4))
            tried_boards = moved(boards, board_step)
            after, tried_rms = _cost(tried, tried_boards, corners, soft, weight)
            if after < before:
                fall = 1 - after / before
                camera, boards, rms = tried, tried_boards, tried_rms
                damping = max(damping / 10, 1e-9)
                break
            damping *= 10
        if fall < 1e-6:
            break
    weight = _view_weights(corners, rms)
    covariance = _normal(camera, boards, corners, soft, weight).lens_covariance()
    return _Refined(camera, boards, rms, float(np.sqrt(covariance[0, 0])))


def views_of(corners: Corners, camera: int) -> IntArray:
    """Indices of the views of one camera."""
    return np.flatnonzero(corners.camera == camera)
