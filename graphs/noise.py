"""How large the pixel noise is, and what the robust loss does to a covariance."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from graphs.boards import N_WHOLE
from graphs.build import GraphOptions
from graphs.covariance import POSE_NAMES
from graphs.frames import FloatArray
from graphs.losses import weight_and_slope
from graphs.problem import IntArray, KnownSpan, Problem, points_in_cameras, whitened

PLACES = tuple(f".{name}" for name in POSE_NAMES)
# Median of the norm of a 2-D Gaussian of unit sigma (Rayleigh): sqrt(2 ln 2).
RAYLEIGH_MEDIAN = float(np.sqrt(2 * np.log(2)))
# Perfect data has no noise; weights need a scale above rounding.
SMALLEST_SIGMA_PX = 1e-3
CORNER_PX = 0.07  # noise of a corner: of seven real sets 0.06 to 0.12 px, as their boards allow
# Of a corner's three: along the line of sight tilted views show it a little.
SHOWN_DIRECTIONS = 2.0
LEAST_REDUNDANCY = 0.1  # of one observation that outweighs the rest of its track
# The sigma of so many, by their median, is itself known to 4 %.
CLASS_SIZE = 400
# Of corners: fewer, and their own places take what would tell their noise. Eight of one view came
# out with 0.0002 px.
BOARD_CLASS_SIZE = 24
WIDEST_FACTOR = 10.0  # between a class's sigma and that of all: beyond, something else is wrong


def free_dimensions(problem: Problem, options: GraphOptions | None = None) -> int:
    """How many numbers the observations have to determine: unknowns less gauge.

    options: say which lens parameters are held, and which cameras share theirs; else all count.
    """
    start, seen = problem.initial, problem.observations
    frames = len(np.unique(seen.frame))
    points = int(np.count_nonzero(~problem.known[np.unique(seen.point)]))
    gauge = 6 if problem.metric else 7
    if problem.of_board_alone:
        gauge = 0
    held = () if problem.prior is None else problem.prior.held
    rig = 6 * (len(start.cameras) - 1) - sum(name.endswith(PLACES) for name in held)
    lenses = _free_lens_parameters(problem, options)
    return lenses + rig + 6 * frames + 3 * points + round(_of_corners(problem).sum()) - gauge


def _of_corners(problem: Problem) -> FloatArray:
    """How many numbers each corner of the board (n_corners,) takes of its views for its own place.

    As many as it has directions that show, less where few views tell less than what is believed.
    """
    seen, known = problem.observations, problem.known[problem.observations.point]
    if problem.board is None or not known.any():
        return np.zeros(0)
    board, start = problem.board.board, problem.initial
    of_board = seen.subset(known)
    views = np.bincount(problem.board.corner[of_board.point], minlength=len(board.corners))
    if len(board.shape_sigma) == N_WHOLE:
        return np.zeros(len(views))
    focal_px = np.array([camera.params[0] for camera in start.cameras])[of_board.camera]
    away = np.linalg.norm(points_in_cameras(start, of_board), axis=1)
    off_px = float(np.median(board.shape_sigma[N_WHOLE:]) * np.median(focal_px / away))
    told = views * (off_px / CORNER_PX) ** 2
    result: FloatArray = SHOWN_DIRECTIONS * told / (1 + told)
    return result


def _free_lens_parameters(problem: Problem, options: GraphOptions | None) -> int:
    free = [camera.params.size for camera in problem.initial.cameras]
    if options is None:
        return sum(free)
    if options.lens_priors:
        free = [int(prior.free.sum()) for prior in options.lens_priors]
    return sum(free) - sum(free[i] for group in options.shared_lenses for i in group[1:])


def redundancy(problem: Problem, options: GraphOptions | None = None) -> float:
    """Share of the measured coordinates left after the unknowns took theirs, in (0, 1]."""
    measured = 2 * len(problem.observations)
    return max(measured - free_dimensions(problem, options), 1) / measured


def redundancies(problem: Problem, options: GraphOptions | None = None) -> FloatArray:
    """The same of each observation (n_obs,): a point takes three numbers of its track.

    It takes them by weight; frames, lenses and rig take theirs from all alike, but for frames that
    see a board.
    """
    seen = problem.observations
    weight = np.ones(len(seen)) if seen.relative_sigma is None else seen.relative_sigma**-2.0
    of_track: FloatArray = np.bincount(seen.point, weight).astype(np.float64)[seen.point]
    left = left_by_point(weight, of_track)
    if problem.board is not None:
        # A corner's place is all but given; its frame has few others to take its own from.
        known = problem.known[seen.point]
        in_frame = np.bincount(seen.frame)[seen.frame[known]]
        corner = problem.board.corner[seen.point[known]]
        taken = _of_corners(problem)
        views = np.bincount(corner, minlength=len(taken))
        own = (taken / np.maximum(2 * views, 1))[corner]
        left[known] = np.maximum(1 - 3 / in_frame - own, LEAST_REDUNDANCY)
    result: FloatArray = left * redundancy(problem, options) / float(left.mean())
    return result


def left_by_point(weight: FloatArray, of_track: FloatArray) -> FloatArray:
    """Share (n_obs,) of each observation that its point leaves, which takes three numbers.

    weight (n_obs,): 1 / sigma^2 of each; of_track (n_obs,): their sum over its track.
    """
    return np.maximum(1 - 1.5 * weight / of_track, LEAST_REDUNDANCY)


def robust_sigma_px(
    problem: Problem, residuals: FloatArray, options: GraphOptions | None = None
) -> float:
    """Sigma of one pixel coordinate from residuals (n_obs, 2), by their median length.

    Of an observation whose relative sigma is 1. Half of the observations may be wild. Fitting
    shrinks residuals; the redundancy undoes it.
    """
    lengths = residual_lengths(problem, residuals)
    median = float(np.median(lengths[np.isfinite(lengths)]))
    return float(median / RAYLEIGH_MEDIAN / np.sqrt(redundancy(problem, options)))


def residual_lengths(problem: Problem, residuals: FloatArray) -> FloatArray:
    """Lengths (n_obs,) of residuals (n_obs, 2) in px, over their relative sigmas and shapes."""
    seen = problem.observations
    if seen.relative_sigma is not None or seen.noise_shape is not None:
        residuals = whitened(residuals, seen.whitening)
    lengths: FloatArray = np.linalg.norm(residuals, axis=1)
    return lengths


def left_by_frame(in_frame: IntArray) -> FloatArray:
    """Share (n,) of a corner that its frame leaves, which takes six numbers of all that it sees.

    in_frame (n,): observations of the frame of each.
    """
    result: FloatArray = np.maximum(1 - 3 / in_frame, LEAST_REDUNDANCY)
    return result


NoiseKind = Literal["keypoints", "matched", "board"]


@dataclass(frozen=True)
class NoiseClass:
    """Observations of one camera whose keypoints are about equally large, and their noise.

    Of matched ones: whose matching states about the same sigma.
    """

    camera: int
    smallest_px: float  # scale of the keypoints, or sigma that their matching states, from
    largest_px: float  # to
    count: int
    sigma_px: float  # robust, of one coordinate
    kind: NoiseKind = "keypoints"

    @property
    def of_board(self) -> bool:
        return self.kind == "board"


def noise_classes(
    problem: Problem, residuals: FloatArray, options: GraphOptions | None = None
) -> tuple[NoiseClass, ...]:
    """The noise of each camera by the size of its keypoints, from residuals (n_obs, 2) in px."""
    seen, found = problem.observations, []
    lengths = residual_lengths(problem, residuals) / np.sqrt(redundancies(problem, options))
    if seen.relative_sigma is not None:
        lengths *= seen.relative_sigma
    for camera, rows, kind in _classes(problem, np.isfinite(lengths)):
        sigma_px = float(np.median(lengths[rows])) / RAYLEIGH_MEDIAN
        by = {"matched": seen.matched_sigma_px, "keypoints": seen.feature_scale}.get(kind)
        ends = (0.0, np.inf)
        if by is not None and np.isfinite(by[rows]).all():
            ends = (float(by[rows].min()), float(by[rows].max()))
        found.append(NoiseClass(camera, *ends, len(rows), sigma_px, kind))
    return tuple(found)


def with_class_sigmas(
    problem: Problem, residuals: FloatArray, options: GraphOptions | None = None
) -> Problem:
    """The problem with observations weighed by the noise of their camera and keypoint size.

    Coarse keypoints are worse: on three real scans the noise grows by 1.6 to 2.2 from the finest
    tenth to the coarsest, while its median is 0.2 to 0.4 px. Relative sigmas that are there
    already are kept but for a factor a class: what `residual_lengths` over them still shows.
    """
    seen = problem.observations
    lengths = residual_lengths(problem, residuals) / np.sqrt(redundancies(problem, options))
    finite = np.isfinite(lengths)
    of_all = float(np.median(lengths[finite])) / RAYLEIGH_MEDIAN if finite.any() else 0.0
    if not of_all > SMALLEST_SIGMA_PX:
        return problem
    relative = np.ones(len(seen)) if seen.relative_sigma is None else seen.relative_sigma.copy()
    for _, rows, _ in _classes(problem, finite):
        factor = float(np.median(lengths[rows])) / RAYLEIGH_MEDIAN / of_all
        relative[rows] *= np.clip(factor, 1 / WIDEST_FACTOR, WIDEST_FACTOR)
    return replace(problem, observations=replace(seen, relative_sigma=relative))


def _classes(
    problem: Problem, projected: NDArray[np.bool_]
) -> Iterator[tuple[int, IntArray, NoiseKind]]:
    """Camera, rows and kind of each class: half octaves of keypoint size, or of the sigma that
    matching states, joined until large enough, and the corners of the board.

    Observations that are not `projected` (n_obs,), and where some sizes are known those whose size
    is not, as those of clicked marks, are in none.
    """
    seen = problem.observations
    of_board = problem.known[seen.point]
    matched = np.zeros(len(seen), dtype=bool)
    if seen.matched_sigma_px is not None:
        matched = np.isfinite(seen.matched_sigma_px)
    for camera in range(len(problem.initial.cameras)):
        own = (seen.camera == camera) & projected
        if (own & of_board).sum() >= BOARD_CLASS_SIZE:
            yield camera, np.flatnonzero(own & of_board), "board"
        for rows in _half_octaves(np.flatnonzero(own & matched), seen.matched_sigma_px):
            yield camera, rows, "matched"
        for rows in _half_octaves(np.flatnonzero(own & ~of_board & ~matched), seen.feature_scale):
            yield camera, rows, "keypoints"


def _half_octaves(rows: IntArray, size: FloatArray | None) -> Iterator[IntArray]:
    """The rows by half octaves of their size (n_obs,), those of too few with the next larger."""
    edges: list[int] = []
    if size is not None and np.isfinite(size).any():
        rows = rows[size[rows] > 0]
        half_octave = np.floor(2 * np.log2(size[rows]))
        rows = rows[np.argsort(half_octave, kind="stable")]
        edges = (np.flatnonzero(np.diff(np.sort(half_octave))) + 1).tolist()
    begin = 0
    for end in [*edges, len(rows)]:
        left = len(rows) - end
        if (end - begin >= CLASS_SIZE and left >= CLASS_SIZE) or (left == 0 and end > begin):
            yield rows[begin:end]
            begin = end


def with_click_sigma(problem: Problem, sigma_px: float) -> Problem:
    """The problem with the ends of each KnownSpan weighed by the sigma that is stated of them.

    sigma_px: of all other observations. Where it is larger it holds for clicks too: what it is
    made of, such as a lens that does not fit, spares none of them.
    """
    seen = problem.observations
    clicked = [
        (source.points, source.click_sigma_px)
        for source in problem.scales
        if isinstance(source, KnownSpan) and source.click_sigma_px is not None
    ]
    if not clicked:
        return problem
    relative = np.ones(len(seen)) if seen.relative_sigma is None else seen.relative_sigma.copy()
    for points, click_sigma_px in clicked:
        relative[np.isin(seen.point, points)] = max(click_sigma_px / sigma_px, 1.0)
    return replace(problem, observations=replace(seen, relative_sigma=relative))


@dataclass(frozen=True)
class LossMoments:
    """What an M-estimator's weights do to its covariance (Huber, Robust Statistics, 1981, 7.6).

    With H the weighted information of the data and P that of the priors, the cost has the
    Hessian c H + P and its gradient the covariance s H + P.
    """

    curvature: float  # c: true curvature of the loss over the weight used in its place
    score_variance: float  # s: both are 1 for Gaussian noise of the assumed sigma and no loss
    refit: float  # already in s: squared scores of the noise over those of the residuals


def loss_moments(problem: Problem, options: GraphOptions, residuals: FloatArray) -> LossMoments:
    """Curvature and score variance of the loss at the residuals (n_obs, 2) of the optimum."""
    lengths = residual_lengths(problem, residuals)
    r = lengths[np.isfinite(lengths)] / options.sigma_px
    weight, slope = weight_and_slope(options.loss, options.loss_scale, r)
    mean, apart = (slope + weight) / 2, (slope - weight) / 2  # curvature along and across
    curvature = float(np.mean(mean))
    scatter = float(np.mean(mean**2 + apart**2 / 2)) - curvature**2
    left = redundancy(problem, options)
    refit = (1 + (1 - left) * scatter / curvature**2) ** 2 / left  # Huber's K^2 n / (n - p)
    score, used = float(np.mean((weight * r) ** 2) / 2), float(np.mean(weight))
    return LossMoments(curvature / used, refit * score / used, refit)


MOST_FREEDOM = 100.0  # a Student t of so many degrees of freedom is a Gaussian
LEAST_FREEDOM = 1.0  # below Cauchy's own distribution no mean exists


def student_t(lengths: FloatArray, iterations: int = 100) -> tuple[float, float]:
    """Scale and degrees of freedom of the bivariate Student t that residuals suit best.

    lengths (n,): of residuals, in any unit. Maximum likelihood by expectation-maximisation
    (Lange, Little and Taylor, JASA 1989). Its negative logarithm is a Cauchy loss of scale
    sqrt(freedom + 2) on residuals in units of `scale` sqrt(freedom / (freedom + 2)).
    """
    s = lengths[np.isfinite(lengths)] ** 2
    scale2, freedom = max(float(np.median(s)) / RAYLEIGH_MEDIAN**2, SMALLEST_SIGMA_PX**2), 4.0
    for _ in range(iterations):
        before = scale2, freedom
        weight = (freedom + 2) / (freedom + s / scale2)
        scale2 = max(float(np.mean(weight * s)) / 2, 1e-300)
        freedom = _freedom(s / scale2)
        if np.allclose(before, (scale2, freedom), rtol=1e-6, atol=0):
            break
    return scale2**0.5, freedom


def _freedom(s: FloatArray) -> float:
    """Degrees of freedom that make squared lengths, in units of the scale, most likely."""

    def unlikely(log_freedom: float) -> float:
        # of the bivariate t the constant is 1 / (2 pi), whatever its freedom
        freedom = np.exp(log_freedom)
        return float((freedom + 2) / 2 * np.mean(np.log1p(s / freedom)))

    bounds = (np.log(LEAST_FREEDOM), np.log(MOST_FREEDOM))
    return float(np.exp(minimize_scalar(unlikely, bounds=bounds, method="bounded").x))


def adapted(problem: Problem, options: GraphOptions, residuals: FloatArray) -> GraphOptions:
    """Options with the noise and loss of the Student t that residuals (n_obs, 2) suit best."""
    scale, freedom = student_t(residual_lengths(problem, residuals))
    scale /= redundancy(problem, options) ** 0.5
    return replace(
        options,
        sigma_px=max(scale * (freedom / (freedom + 2)) ** 0.5, SMALLEST_SIGMA_PX),
        loss="cauchy",
        loss_scale=(freedom + 2) ** 0.5,
    )
