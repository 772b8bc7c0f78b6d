"""Two halves of a scan, each calibrated alone: do they agree as well as the sigmas claim?

The idea is mrcal's cross-validation: what two calibrations project differently, once a rotation of
the rig has undone what it can, is what really is uncertain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from graphs.build import CalibrationGraph
from graphs.frames import FloatArray
from graphs.image_grid import image_grid, typical_distances
from graphs.jackknife import blocks_of, solve_part
from graphs.model_covariance import ModelCovariance
from graphs.problem import BoolArray, Estimate
from graphs.stated_covariance import CalibrationCovariance, factors

DRAWS, SEED = 20_000, 0  # of the distribution of what is expected
SURPRISING = 0.01  # probability below which halves are said to disagree
# Halves that may lie so far apart agree with anything: 3 to 5 px in the real scans.
TOO_LITTLE_PX = 15.0


@dataclass(frozen=True)
class SplitCheck:
    """How far two halves project apart over all images, and how far the sigmas let expect."""

    difference_px: float  # rms over the images, both coordinates together
    expected_px: float  # rms that the stated covariances of the two halves predict
    model_px: float  # the same of the model's
    p_value: float  # probability of a larger difference, if the stated covariances are true

    @property
    def agrees(self) -> bool:
        return self.p_value > SURPRISING


def split_check(
    graph: CalibrationGraph,
    estimate: Estimate,
    covariance: CalibrationCovariance,
    min_parallax_deg: float,
) -> SplitCheck | None:
    """Solve every second block of frames, and the others, alone, and compare their projections.

    The halves see the same points, but no common image other than those that give the unit.
    None where one of them determines the calibration too little, and where nothing is estimated.
    """
    if not covariance.basis.names:
        return None
    model, second = covariance.basis, blocks_of(graph.problem) % 2 == 1
    halves = _solved(graph, estimate, model, second, min_parallax_deg)
    if halves is None:
        return None
    grid = _grid(graph, estimate, model)
    squared = _squared_px(grid, halves)
    widening = _widening(model.matrix, covariance.stated.matrix)
    of_halves = _of_difference(halves[0][1], halves[1][1])
    by_all = grid.reshape(-1, len(model.names)) / len(grid) ** 0.5
    expected = by_all @ factors(widening @ of_halves @ widening.T)[0]
    weights = np.linalg.svd(expected, compute_uv=False) ** 2
    draws = np.random.default_rng(SEED).standard_normal((DRAWS, len(weights))) ** 2 @ weights
    expected_px = float(weights.sum()) ** 0.5
    if expected_px > TOO_LITTLE_PX:
        return None
    return SplitCheck(
        squared**0.5,
        expected_px,
        float(np.trace(by_all @ of_halves @ by_all.T)) ** 0.5,
        float((np.count_nonzero(draws >= squared) + 1) / (DRAWS + 1)),
    )


def difference_px(
    graph: CalibrationGraph,
    estimate: Estimate,
    model: ModelCovariance,
    second: BoolArray,
    min_parallax_deg: float,
) -> float | None:
    """How far any two halves project apart, rms over all images; second (n_frames,): the second's.

    None as of `split_check`.
    """
    if not model.names:
        return None
    halves = _solved(graph, estimate, model, second, min_parallax_deg)
    return halves and _squared_px(_grid(graph, estimate, model), halves) ** 0.5


Half = tuple[FloatArray, ModelCovariance]  # as `solve_part` gives it


def _solved(
    graph: CalibrationGraph,
    estimate: Estimate,
    model: ModelCovariance,
    second: BoolArray,
    min_parallax_deg: float,
) -> tuple[Half, Half] | None:
    halves = [
        solve_part(graph, estimate, model, frames, min_parallax_deg) for frames in (~second, second)
    ]
    return None if halves[0] is None or halves[1] is None else (halves[0], halves[1])


def _grid(graph: CalibrationGraph, estimate: Estimate, model: ModelCovariance) -> FloatArray:
    """How pixels over all images move with the parameters (n_pixels, 2, n)."""
    in_unit = estimate.scaled(1 / model.unit)
    distances = typical_distances(in_unit, graph.problem.observations)
    return image_grid(in_unit, model.names, distances.tolist()).settled


def _squared_px(grid: FloatArray, halves: tuple[Half, Half]) -> float:
    return float(((grid @ (halves[0][0] - halves[1][0])) ** 2).sum(-1).mean())


def _of_difference(a: ModelCovariance, b: ModelCovariance) -> FloatArray:
    """Covariance (n, n) of a less b, which lean on the same priors and the same measured length."""
    shared = a.of_priors.T @ b.of_priors
    result: FloatArray = a.matrix + b.matrix - shared - shared.T
    return result


def _widening(model: FloatArray, stated: FloatArray) -> FloatArray:
    """T (n, n) with T M T' = S: how the model's errors have to be stretched to be the stated."""
    root, whiten = factors(model)
    values, vectors = np.linalg.eigh(whiten @ stated @ whiten.T)
    stretch = vectors * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    result: FloatArray = root @ stretch @ whiten
    return result
