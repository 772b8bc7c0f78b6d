"""Covariances from few samples: shrunk towards a multiple of the identity."""

from __future__ import annotations

import numpy as np

from graphs.frames import FloatArray


def shrunk(scatter: FloatArray, n_samples: int) -> FloatArray:
    """The mean (n, n) of the outer products of so many samples, shrunk as far as they are few.

    Oracle approximating shrinkage (Chen, Wiesel, Eldar and Hero, IEEE TSP 2010, equation 23): of
    Gaussian samples, the mix of their scatter and of the mean of its eigenvalues that is expected
    to be nearest to the truth.
    """
    n = len(scatter)
    trace, square = float(np.trace(scatter)), float((scatter**2).sum())
    spread = (n_samples + 1 - 2 / n) * (square - trace**2 / n)
    own = (1 - 2 / n) * square + trace**2
    weight = 1.0 if own >= spread else own / spread
    result: FloatArray = (1 - weight) * scatter + weight * trace / n * np.eye(n)
    return result
