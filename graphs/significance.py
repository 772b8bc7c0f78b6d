"""Tests of many small changes at once: chi-square, Holm's correction, and what a test could find.

Changes are in px of the picture, so that a size means the same whatever the parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import optimize, stats

from graphs.compare_chance import LEAST_RELATIVE, LEAST_SIGMA_PX
from graphs.frames import FloatArray

# A change along what both sides know exactly is a change, but for files that round.
ROUNDING_PX = 0.01
MOST_NONCENTRAL = 1e4  # of a chi-square: no power asks for more


@dataclass(frozen=True)
class Significance:
    """A change against its covariance."""

    chi2: float  # infinite where what is exactly known changed
    dof: int  # directions with a sigma
    p_value: float  # of a larger chi2, where nothing changed


def significance(change: FloatArray, cov: FloatArray) -> Significance:
    """Of a change (k,) in px with covariance (k, k) in px^2, which may be singular.

    chi2 = change' cov^+ change. Directions without a sigma are exactly known: a change along them
    by more than ROUNDING_PX is no chance.
    """
    if not len(change):
        return Significance(0.0, 0, 1.0)
    values, vectors = np.linalg.eigh((cov + cov.T) / 2)
    sigma = np.sqrt(np.maximum(values, 0.0))
    counts = sigma > max(LEAST_RELATIVE * float(sigma[-1]), LEAST_SIGMA_PX)
    along = vectors.T @ change
    if np.linalg.norm(along[~counts]) > ROUNDING_PX:
        return Significance(np.inf, int(counts.sum()), 0.0)
    chi2, dof = (
        float(((along / np.where(counts, sigma, 1.0))[counts] ** 2).sum()),
        int(counts.sum()),
    )
    return Significance(chi2, dof, float(stats.chi2.sf(chi2, dof)) if dof else 1.0)


def holm(p_values: Sequence[float]) -> FloatArray:
    """p-values (n,) corrected for there being n of them, whatever their correlations.

    The i-th smallest counts n + 1 - i times, and no less than a smaller one (Holm, "A simple
    sequentially rejective multiple test procedure", 1979). The chance of one below alpha where
    nothing changed is at most alpha.
    """
    p = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(p, kind="stable")
    times = len(p) - np.arange(len(p))
    corrected = np.empty(len(p))
    corrected[order] = np.minimum(np.maximum.accumulate(times * p[order]), 1.0)
    return corrected


@lru_cache(maxsize=256)
def noncentrality(alpha: float, dof: int, power: float) -> float:
    """Of a chi-square so that a test at level alpha rejects with that power; alpha < power."""
    limit = stats.chi2.isf(alpha, dof)

    def missing(size: float) -> float:
        return float(stats.ncx2.sf(limit, dof, size)) - power

    return float(optimize.brentq(missing, 1e-9, MOST_NONCENTRAL, xtol=1e-6))


def detectable(cov: FloatArray, alpha: float, power: float) -> float:
    """The change in px from which on a test finds every one with that power.

    Along the direction that is worst to find, sqrt(lambda0 lambda_max(cov)), with lambda0 the
    noncentrality: the minimal detectable bias of Baarda ("A testing procedure for use in geodetic
    networks", 1968). 0 where all is exactly known.
    """
    if not len(cov):
        return 0.0
    values = np.linalg.eigvalsh((cov + cov.T) / 2)
    sigma = np.sqrt(np.maximum(values, 0.0))
    dof = int((sigma > max(LEAST_RELATIVE * float(sigma[-1]), LEAST_SIGMA_PX)).sum())
    return noncentrality(alpha, dof, power) ** 0.5 * float(sigma[-1]) if dof else 0.0
