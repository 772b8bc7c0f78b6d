"""The covariance that is stated: the model's, and what errs together beyond it.

The model takes observations for independent. In real scans they are not, and more of them do not
help: a keypoint drifts off its corner as the view changes and takes its track along; a shutter
rolls, and a frame errs as one; a lens that does not fit errs the same way wherever in the image a
feature is seen. Three sums of the observations' influences show by how much, over tracks, frames
and cells of the image plane (a sandwich clustered in three ways); what whole blocks of frames
share, and what is not linear, a delete-group jackknife does. Each is compared with what it would be
if observations were independent, and the excess is added to the model's covariance:

    stated = model + blocks of frames beyond it + tracks beyond it + cells beyond it,

each shrunk as far as its few clusters leave its shape open. Where nothing errs together this is the
model's covariance; it is never less. Without blocks (few frames) single frames take their place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np

from graphs.build import CalibrationGraph
from graphs.clusters import homogeneous
from graphs.covariance import Covariance
from graphs.frames import FloatArray
from graphs.influence import SharedErrors, shared_errors
from graphs.jackknife import Jackknife, delete_group_jackknife
from graphs.model_covariance import ModelCovariance, model_covariance
from graphs.problem import Estimate
from graphs.shrinkage import shrunk
from graphs.threads import threads

MIN_FRAMES = 5  # fewer cannot show how much frames differ
MIN_CLUSTERS = 5  # of tracks, and of corners
# Of the variance of a parameter, correlations taken out: less of it is rounding. Real lenses'
# weakest combinations have 1e-6.
LEAST_EIGENVALUE = 1e-10
# Of the variance along a direction, what the noise of the data brings: less, and a prior decides.
# With a measured baseline the size of the rig has 1e-12; what it moves by is rounding.
LEAST_DATA_SHARE = 1e-4


@dataclass(frozen=True)
class CalibrationCovariance:
    """The stated covariance, and what it was made from."""

    stated: Covariance
    robust: Covariance  # clustered by frames, tracks and cells; without the jackknife
    jackknife: Jackknife | None
    basis: ModelCovariance

    @property
    def model(self) -> Covariance:
        """The covariance if all observations were independent."""
        return self.basis.covariance

    @property
    def inflation(self) -> float:
        """Median of stated over model sigma; 1 where nothing is estimated."""
        ratios = list(self.inflations.values())
        return float(np.median(ratios)) if ratios else 1.0

    @property
    def inflations(self) -> dict[str, float]:
        """Stated over model sigma of every parameter that is not exactly known."""
        return {
            name: self.stated.sigma[name] / sigma
            for name, sigma in self.model.sigma.items()
            if sigma > 0
        }


def calibration_covariance(
    graph: CalibrationGraph,
    estimate: Estimate,
    values: gtsam.Values,
    min_parallax_deg: float | None = None,
    on_block: Callable[[int, int], None] | None = None,
) -> CalibrationCovariance:
    """Covariance of every free lens parameter and every cam_from_rig at the optimum.

    Lengths of a rig without scale are in units of its longest baseline (`basis.unit`).
    min_parallax_deg: of tracks, when the scan is solved again for the jackknife; without it, none
    is made. on_block: as `delete_group_jackknife`.
    Raises ValueError when the problem determines less than it asks for.
    """
    model = model_covariance(graph, estimate, values)
    if not model.names:
        return CalibrationCovariance(model.covariance, model.covariance, None, model)
    root, whiten = _of_data(model)
    if not len(whiten):  # priors decide everything
        return CalibrationCovariance(model.covariance, model.covariance, None, model)
    with threads() as pool:
        points = homogeneous(graph.tracks, estimate.points)
        shared = shared_errors(
            graph, graph.variables(values), points, model.response @ whiten.T, pool
        )
    frames = _of_frames(shared)
    others = _of_tracks(shared) + _of_corners(shared) + _of_cells(shared)
    robust = _widened(model, root, frames + others)
    stated, jackknife = robust, None
    if min_parallax_deg is not None:
        jackknife = delete_group_jackknife(graph, estimate, model, min_parallax_deg, on_block)
    if jackknife is not None:
        stated = _widened(model, root, _of_blocks(jackknife, whiten) + others)
    return CalibrationCovariance(stated, robust, jackknife, model)


def factors(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """R (n, r) and W (r, n) with R R' a covariance (n, n) of rank r, and W R the identity."""
    sigma = np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    values, vectors = np.linalg.eigh(matrix / np.outer(sigma, sigma))
    kept = values > LEAST_EIGENVALUE
    length = np.sqrt(values[kept])
    return sigma[:, None] * vectors[:, kept] * length, (vectors[:, kept] / length).T / sigma


def _of_data(model: ModelCovariance) -> tuple[FloatArray, FloatArray]:
    """The same of what the data's noise adds, but for directions that priors alone decide."""
    root, whiten = factors(model.matrix)
    share, vectors = np.linalg.eigh(whiten @ model.from_data @ whiten.T)
    kept = share > LEAST_DATA_SHARE
    length = np.sqrt(share[kept])
    return root @ vectors[:, kept] * length, (vectors[:, kept] / length).T @ whiten


def _of_frames(shared: SharedErrors) -> FloatArray:
    """What frames err together, in units of the data's covariance, less what they would alone."""
    seen = shared.by_frame[shared.by_frame.any(axis=1)]
    if len(seen) < MIN_FRAMES:
        return np.zeros_like(shared.by_track)
    # What moves a frame moves nothing else: the sum over it is free of its fit.
    return _excess(seen.T @ seen, len(seen), shared.before_frames)


def _of_tracks(shared: SharedErrors) -> FloatArray:
    # What moves a track's point moves nothing else: the sum over a track is free of its fit, and
    # to be compared with residuals that are.
    if len(shared.by_corner):
        return _excess_of_part(
            shared.by_track, shared.n_tracks, shared.before_fit, _before_fits(shared)
        )
    return _excess(shared.by_track, shared.n_tracks, float(np.trace(shared.before_fit)))


def _of_corners(shared: SharedErrors) -> FloatArray:
    """What corners of the board err in all frames alike: printed wrongly, or found wrongly."""
    seen = shared.by_corner[shared.by_corner.any(axis=1)]
    return _excess_of_part(seen.T @ seen, len(seen), shared.of_corners, _before_fits(shared))


def _before_fits(shared: SharedErrors) -> float:
    """What the scatter of all data has for a trace, points and frames not fitted to it."""
    of_tracks = shared.alone - float(np.trace(shared.of_corners))
    return float(np.trace(shared.before_fit)) + shared.before_frames - of_tracks


def _of_cells(shared: SharedErrors) -> FloatArray:
    seen = shared.by_cell[shared.by_cell.any(axis=1)]
    return _excess(seen.T @ seen, len(seen), shared.alone)


def _excess(scatter: FloatArray, n_clusters: int, independent: float) -> FloatArray:
    """`independent`: the trace of the scatter that independent observations would have."""
    alone = independent / len(scatter)
    finite = n_clusters / max(n_clusters - 1, 1)
    result: FloatArray = finite * shrunk(scatter, n_clusters) / alone - np.eye(len(scatter))
    return result


def _excess_of_part(
    scatter: FloatArray, n_clusters: int, independent: FloatArray, of_all: float
) -> FloatArray:
    """The same of clusters that hold a part of the data, such as the corners of a board alone.

    independent (n, n): the scatter if these were independent, which a part has a shape of its own
    for; of_all: the trace of that of all the data.
    """
    values, vectors = np.linalg.eigh(independent)
    kept = values > LEAST_EIGENVALUE * of_all
    if n_clusters < MIN_CLUSTERS or not kept.any():
        return np.zeros_like(scatter)
    root = vectors[:, kept] * np.sqrt(values[kept])
    whiten = (vectors[:, kept] / np.sqrt(values[kept])).T
    excess = _excess(whiten @ scatter @ whiten.T, n_clusters, float(kept.sum()))
    result: FloatArray = root @ excess @ root.T * (len(scatter) / of_all)
    return result


def _of_blocks(jackknife: Jackknife, whiten: FloatArray) -> FloatArray:
    """What blocks of frames err together beyond what the model expects of the jackknife.

    Of so few blocks an excess of the size of its own standard error is none: it is shrunk as James
    and Stein shrink a mean (1961). What is left is itself a guess, and as many times larger as
    Student's t of so many degrees of freedom spreads more than a Gaussian.
    """
    n_blocks, n = len(jackknife.moved), len(whiten)
    scatter = whiten @ jackknife.covariance @ whiten.T
    expected = jackknife.weight * np.trace(whiten @ jackknife.expected @ whiten.T) / n
    of_blocks = n_blocks * jackknife.weight / n * ((jackknife.moved @ whiten.T) ** 2).sum(1)
    excess, error = of_blocks.mean() - expected, of_blocks.std(ddof=1) / n_blocks**0.5
    if excess <= error:
        return np.zeros((n, n))
    kept = (1 - (error / excess) ** 2) * n_blocks / (n_blocks - 2)
    result: FloatArray = kept * (shrunk(scatter, n_blocks) - expected * np.eye(n))
    return result


def _widened(model: ModelCovariance, root: FloatArray, excess: FloatArray) -> Covariance:
    values, vectors = np.linalg.eigh(excess)
    wider = root @ vectors * np.sqrt(np.maximum(values, 0.0))
    return Covariance(model.names, model.matrix + wider @ wider.T)
