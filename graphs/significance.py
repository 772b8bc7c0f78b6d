"""Tests of many small changes at once: chi-square, Holm's correction, and what a test could find.

Changes are in px of the picture, so that a size means the same whatever the parameters. A
covariance that rests on how much nu + 1 frames differ is itself a guess: then chi2 / k is no
chi-square over k, but an F of k and nu.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

from graphs.compare_chance import LEAST_RELATIVE, LEAST_SIGMA_PX
from graphs.frames import FloatArray

# A change along what both sides know exactly is a change, but for files that round.
ROUNDING_PX = 0.01
MOST_DEGREES = 1e5  # more, and an F is a chi-square to five digits
MOST_NONCENTRAL = 1e4  # no power asks for more
# From here on only the guess of the covariance scatters, to 2 / sqrt(FAR); scipy's noncentral F
# sums up to some 1e9 alone.
FAR = 3e3


@dataclass(frozen=True)
class Significance:
    """A change against its covariance."""

    chi2: float  # infinite where what is exactly known changed
    dof: int  # directions with a sigma
    p_value: float  # of a larger chi2, where nothing changed


def significance(change: FloatArray, cov: FloatArray, nu: float = np.inf) -> Significance:
    """Of a change (k,) in px with covariance (k, k) in px^2, which may be singular.

    chi2 = change' cov^+ change, and chi2 / k an F of k and nu; nu: degrees of freedom of the
    covariance's size; inf: it is known. Directions without a sigma are exactly known: a change
    along them by more than ROUNDING_PX is no chance.
    """
    if not len(change):
        return Significance(0.0, 0, 1.0)
    values, vectors = _along(cov)
    counts = _counts(values)
    along = vectors.T @ change
    if np.linalg.norm(along[~counts]) > ROUNDING_PX:
        return Significance(np.inf, int(counts.sum()), 0.0)
    chi2, dof = float((along[counts] ** 2 / values[counts]).sum()), int(counts.sum())
    return Significance(chi2, dof, tail(chi2, dof, nu) if dof else 1.0)


@dataclass(frozen=True)
class Guess:
    """A part of a covariance that was estimated from how much a few things differ."""

    cov: FloatArray  # (k, k)
    nu: float  # degrees of freedom; infinite: it is known

    def carried(self, part: FloatArray) -> Guess:
        """Of part (m, k) times what it is of."""
        return Guess(part @ self.cov @ part.T, self.nu)


def degrees(cov: FloatArray, guesses: Sequence[Guess]) -> float:
    """Degrees of freedom of a covariance (k, k) that parts of it were guessed of.

    1 / nu = sum of share^2 / nu of each (Satterthwaite, "An approximate distribution of estimates
    of variance components", 1946), its share being that in the direction that rests on it most:
    where what is known makes up the rest, a guess matters less.
    """
    if not len(cov):
        return np.inf
    values, vectors = _along(cov)
    counts = _counts(values)
    if not counts.any():
        return np.inf
    whiten = vectors[:, counts] / np.sqrt(values[counts])
    shares = [float(np.linalg.eigvalsh(whiten.T @ one.cov @ whiten)[-1]) for one in guesses]
    doubt = sum(min(s, 1.0) ** 2 / one.nu for s, one in zip(shares, guesses, strict=True))
    return np.inf if doubt <= 1 / MOST_DEGREES else 1 / doubt


def _along(cov: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Variances (k,), the largest last, and the directions (k, k) that have them."""
    values, vectors = np.linalg.eigh((cov + cov.T) / 2)
    return values, vectors


def _counts(variances: FloatArray) -> NDArray[np.bool_]:
    """Which (k,) of the eigenvalues of a covariance are no rounding; the largest comes last."""
    sigma = np.sqrt(np.maximum(variances, 0.0))
    return np.asarray(sigma > max(LEAST_RELATIVE * float(sigma[-1]), LEAST_SIGMA_PX))


def tail(chi2: float, dof: int, nu: float) -> float:
    """p-value of a chi2 against a covariance of nu degrees of freedom."""
    return float(stats.chi2.sf(chi2, dof) if np.isinf(nu) else stats.f.sf(chi2 / dof, dof, nu))


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


def rejecting(alpha: float, dof: int, nu: float = np.inf) -> Callable[[float], float]:
    """How often a test at level alpha rejects, by the noncentrality of its chi2."""
    if np.isinf(nu):
        return partial(stats.ncx2.sf, stats.chi2.isf(alpha, dof), dof)
    return partial(stats.ncf.sf, stats.f.isf(alpha, dof, nu), dof, nu)


@lru_cache(maxsize=1024)
def noncentrality(alpha: float, dof: int, power: float, nu: float = np.inf) -> float:
    """Of a chi-square (an F of dof and nu) so that a test at level alpha rejects with that power;
    alpha < power."""
    if not np.isinf(nu):
        far = float(stats.f.isf(alpha, dof, nu) * dof * stats.chi2.ppf(power, nu) / nu)
        if far > FAR:
            return far
    rejected = rejecting(alpha, dof, nu)

    def missing(size: float) -> float:
        return float(rejected(size)) - power

    return float(optimize.brentq(missing, 1e-9, MOST_NONCENTRAL, xtol=1e-6))


def detectable(cov: FloatArray, alpha: float, power: float, nu: float = np.inf) -> float:
    """The change in px from which on a test finds every one with that power.

    Along the direction that is worst to find, sqrt(lambda0 lambda_max(cov)), with lambda0 the
    noncentrality: the minimal detectable bias of Baarda ("A testing procedure for use in geodetic
    networks", 1968). 0 where all is exactly known. nu: as `significance`.
    """
    if not len(cov):
        return 0.0
    values = _along(cov)[0]
    dof = int(_counts(values).sum())
    return (noncentrality(alpha, dof, power, nu) * float(values[-1])) ** 0.5 if dof else 0.0
