"""Sources of metric scale: measured distances between cameras, frames, or scene points."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np

from graphs.clusters import Cluster, Tracks, homogeneous, make_tracks
from graphs.elimination import Elimination, Front
from graphs.frames import FloatArray
from graphs.keys import frame_key, rig_key
from graphs.losses import LossName
from graphs.problem import (
    Estimate,
    IntArray,
    KnownBaseline,
    KnownPath,
    KnownSpan,
    Problem,
    ScaleSource,
)
from graphs.rows import bearing_basis
from graphs.system import shared_keys, track_columns, variables_of
from graphs.tracks import TRIANGULATION_TOLERANCE, Rows, Variables, rows_of, triangulate_cluster


def length_of(scale: ScaleSource, estimate: Estimate) -> float:
    """The measured distance as the estimate has it."""
    if isinstance(scale, KnownBaseline):
        ends = [estimate.cam_from_rig[i].inverse.translation for i in scale.cameras]
    elif isinstance(scale, KnownPath):
        ends = [estimate.rig_from_world[i].inverse.translation for i in scale.frames]
    else:
        ends = [estimate.points[i] for i in scale.points]
    return float(np.linalg.norm(ends[1] - ends[0]))


def scale_factor(
    problem: Problem,
    scale: ScaleSource,
    root_information: FloatArray,
    lens_of: tuple[int, ...],
    loss: LossName,
    loss_scale: float,
) -> gtsam.NonlinearFactor:
    """A scale source of the problem as a factor; root_information (n_obs, 3) of pixels."""
    if not isinstance(scale, KnownSpan):
        return range_factor(scale)
    return _Span(problem, scale, root_information, lens_of, loss, loss_scale).factor()


def total_sigma_m(
    problem: Problem,
    scale: ScaleSource,
    root_information: FloatArray,
    lens_of: tuple[int, ...],
    loss: LossName,
    loss_scale: float,
    values: gtsam.Values,
) -> float:
    """Sigma of a measured distance; between points, that of their own pixels included."""
    if not isinstance(scale, KnownSpan):
        return scale.sigma_m
    span = _Span(problem, scale, root_information, lens_of, loss, loss_scale)
    frames = np.unique(span.problem.observations.frame)
    variables = variables_of(values, span.problem, lens_of, span.order, frames)
    return span.distance(variables)[2]


def range_factor(scale: KnownBaseline | KnownPath) -> gtsam.NonlinearFactor:
    """A measured distance between two cameras or two frames as GTSAM's own factor."""
    pair = scale.cameras if isinstance(scale, KnownBaseline) else scale.frames
    key = rig_key if isinstance(scale, KnownBaseline) else frame_key
    noise = gtsam.noiseModel.Isotropic.Sigma(1, scale.sigma_m)
    return gtsam.RangeFactorPose3(key(pair[0]), key(pair[1]), scale.length_m, noise)


class _Span:
    """A measured distance between two points, which are no variables but follow from tracks.

    With V = B^T B and W = B^T A of a point's track, moving the variables by x moves the point by
    -V^-1 W x. Eliminating the point together with the distance leaves the row -J V^-1 W with the
    variance sigma^2 + J V^-1 J^T (Woodbury): the tape's noise and the points' own.
    """

    def __init__(
        self,
        problem: Problem,
        scale: KnownSpan,
        root_information: FloatArray,
        lens_of: tuple[int, ...],
        loss: LossName,
        loss_scale: float,
    ) -> None:
        seen = problem.observations
        keep = np.isin(seen.point, scale.points)
        observations = seen.subset(keep)
        self.scale, self.lens_of = scale, lens_of
        point = np.searchsorted(np.sort(scale.points), observations.point)
        ends = replace(problem.initial, points=problem.initial.points[np.sort(scale.points)])
        self.problem = replace(
            problem,
            initial=ends,
            observations=replace(observations, point=point),
            scales=(),
            board=None,
        )
        columns = track_columns(problem, lens_of)
        self.order = np.arange(len(problem.frame_names))
        whole = Elimination(self.order, (Front(self.order, len(self.order), -1),), columns.width)
        self.tracks: Tracks = make_tracks(
            self.problem, root_information[keep], whole, columns, loss, loss_scale
        )
        self.ends = [part for cluster in self.tracks.clusters for part in cluster.parts(1)]
        self.warm = homogeneous(self.tracks, ends.points)

    def factor(self) -> gtsam.CustomFactor:
        frames = np.unique(self.problem.observations.frame)
        keys = [frame_key(f) for f in frames] + shared_keys(self.problem, self.lens_of)
        width = self.tracks.columns.width

        def error(
            factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[FloatArray] | None
        ) -> FloatArray:
            variables = variables_of(values, self.problem, self.lens_of, self.order, frames)
            length, row, sigma = self.distance(variables)
            if jacobians is not None:
                row = row / sigma
                blocks = [row[6 * f : 6 * f + 6] for f in frames]
                rest = row[len(row) - width :]
                sizes = [values.zeroVectors().at(key).size for key in keys[len(frames) :]]
                blocks += np.split(rest, np.cumsum(sizes)[:-1])
                for index, block in enumerate(blocks):
                    jacobians[index] = np.asfortranarray(block[None, :])
            return np.array([(length - self.scale.length_m) / sigma])

        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), keys, error)

    def distance(self, variables: Variables) -> tuple[float, FloatArray, float]:
        """The ends' distance, how it follows the variables (n,), and its sigma beside them."""
        places, pulls, covariances = zip(
            *(self._point(end, variables) for end in self.ends), strict=True
        )
        along = places[1] - places[0]
        length = float(np.linalg.norm(along))
        J = along / length
        spread = sum(float(J @ covariance @ J) for covariance in covariances)
        return length, J @ (pulls[1] - pulls[0]), (self.scale.sigma_m**2 + spread) ** 0.5

    def _point(
        self, end: Cluster, variables: Variables
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Place (3,) of one end, how it follows the variables (3, n), and its covariance (3, 3)."""
        point = self.warm[end.points].copy()
        # Losses have minima beside the right one, least squares next to none: from there, the
        # place does not jump as the variables move away from where `warm` was right.
        for tracks in (replace(self.tracks, loss="none"), self.tracks):
            triangulate_cluster(tracks, end, variables, point, TRIANGULATION_TOLERANCE)
        (chunk,) = rows_of(self.tracks, end, variables, point)
        A = self._dense(chunk, end.frames)
        B = chunk.of_point[: len(chunk.rows)].reshape(-1, 3)
        inverse = np.linalg.pinv(B.T @ B)
        basis = np.empty((2, 3))
        bearing_basis(point[0], basis)
        d, w = point[0, :3], point[0, 3]
        by_point = np.column_stack([basis[0] / w, basis[1] / w, -d / w**2])
        return (
            end.anchors[0] + d / w,
            -by_point @ inverse @ B.T @ A,
            by_point @ inverse @ by_point.T,
        )

    def _dense(self, chunk: Rows, frames: IntArray) -> FloatArray:
        """Rows of a track (2 n_obs, n_columns) by all frames and shared variables."""
        columns, start = self.tracks.columns, 6 * len(self.order)
        A = np.zeros((len(chunk.rows), 2, start + columns.width))
        for i, (_, _, f, c) in enumerate(chunk.rows):
            n, at, lens = columns.n_params[c], 6 * frames[f], start + columns.lens[c]
            A[i, :, at : at + 6] += chunk.of_frame[i]
            A[i, :, lens : lens + n] += chunk.of_lens[i, :, :n]
            if columns.rig[c] >= 0:
                rig = start + columns.rig[c]
                A[i, :, rig : rig + 6] += chunk.of_rig[i]
        return A.reshape(-1, A.shape[2])
