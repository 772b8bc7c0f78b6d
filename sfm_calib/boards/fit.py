"""Least squares fits of many small image windows at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve

from graphs.frames import FloatArray

# values (n, p) and Jacobian (n, p, k) at parameters (n, k) and offsets (n, p, 2) from the window's
# middle.
Values = NDArray[np.floating]
Model = Callable[[Values, Values], tuple[Values, Values]]

ITERATIONS = 12
FIRST_DAMPING = 1e-3
RECUT_PX = 0.5  # a window that its centre has moved so far is cut anew
MOST_SLOPE = 1e8  # grey levels by any parameter: a fit that runs away
FEWEST_SPARE = 4  # pixels beyond the number of parameters
# A window is no corner or disc if the fit leaves so much of its variance; or if it leaves some and
# is far noisier than the others, as where a finger covers a part.
MOST_LEFT = 0.4
ODD_NOISE, ODD_SHARE = 6.0, 0.03
MOST_SIGMA_PX = 1.0  # a centre that is known less well is not found
STILL_PX = 1e-3  # a step that moves no centre farther is the last
PIXEL_PX = 0.3  # sigma of the blur by a pixel's own area, 1 / sqrt(12): no edge is sharper
LAGS = 2  # px within which a sensor's or a codec's noise is taken to be correlated
QUANTISATION = 1 / 12  # variance of rounding to grey levels: no image has less noise
# Windows tell their own noise from so many pixels; the image's mean counts as much.
PRIOR_PIXELS = 20


def blur_width(log_blur: Values) -> tuple[Values, Values]:
    """Width of the error function of an edge with a blur of this sigma (log px) and the pixel's
    own, and the derivative of the width's log."""
    lens = np.exp(2 * log_blur)
    total = lens + PIXEL_PX**2
    return np.sqrt(2 * total), lens / total


@dataclass(frozen=True)
class Windows:
    """Round windows of an image around whole pixels, with the pixels that count in each."""

    middle: FloatArray  # (n, 2) whole pixels
    offsets: Values  # (p, 2) from the middle
    values: Values  # (n, p) grey levels
    counts: Values  # (n, p) 1 or 0


@dataclass(frozen=True)
class Fits:
    """Fitted windows; parameters 0 and 1 of each are the centre, in px from the middle."""

    parameters: FloatArray  # (n, k)
    residuals: Values  # (n, p), 0 where a pixel does not count
    jacobian: Values  # (n, p, k)


def cut(
    image: NDArray[np.uint8], centres: FloatArray, radii_px: FloatArray, largest_px: float = 1.0
) -> Windows:
    """Discs of the image (height, width) around centres (n, 2), each with its own radius (n,)."""
    largest = float(radii_px.max(initial=largest_px))
    reach = int(np.ceil(largest))
    steps = np.arange(-reach, reach + 1)
    x, y = np.meshgrid(steps, steps)
    near = x**2 + y**2 <= (largest + 1) ** 2  # a centre is off by 0.7 at most
    offsets = np.column_stack([x[near], y[near]])
    middle = np.rint(centres)
    place = middle.astype(int)[:, None] + offsets  # (n, p, 2)
    height, width = image.shape
    inside = (place >= 0).all(axis=-1) & (place[..., 0] < width) & (place[..., 1] < height)
    column, row = np.clip(place[..., 0], 0, width - 1), np.clip(place[..., 1], 0, height - 1)
    squared = ((place - centres[:, None]) ** 2).sum(axis=-1)
    counts = inside & (squared <= radii_px[:, None] ** 2)
    return Windows(
        middle,
        offsets.astype(np.float32),
        image[row, column].astype(np.float32),
        counts.astype(np.float32),
    )


def fit_centres(
    model: Model,
    contrast: int,
    image: NDArray[np.uint8],
    pixels: FloatArray,
    radii_px: FloatArray,
    start: FloatArray,
) -> tuple[Windows, Fits, NDArray[np.bool_]]:
    """Fit windows around `pixels` (n, 2), and those whose centre moved once more about it.

    `start` (n, k) needs what lies between the centre and the contrast, which is parameter
    `contrast` and is followed by the mean. The last says (n,) which fits stayed in their windows.
    """
    windows = cut(image, pixels, radii_px)
    fits = fit(model, windows, _with_levels(model, contrast, windows, pixels, start))
    centres = windows.middle + fits.parameters[:, :2]
    usable = windows.counts.sum(axis=1) > start.shape[1] + FEWEST_SPARE
    found = usable & (np.hypot(*(centres - pixels).T) < radii_px)  # False of NaN
    again = np.flatnonzero(found & (np.abs(centres - pixels).max(axis=1) > RECUT_PX))
    if len(again):
        own = cut(image, centres[again], radii_px[again], float(radii_px.max()))
        refit = fit(model, own, _moved(fits.parameters[again], centres[again] - own.middle))
        for whole, part in ((windows.middle, own.middle), (windows.values, own.values)):
            whole[again] = part
        windows.counts[again] = own.counts
        fits.parameters[again] = refit.parameters
        fits.residuals[again] = refit.residuals
        fits.jacobian[again] = refit.jacobian
        centres = windows.middle + fits.parameters[:, :2]
        found &= np.hypot(*(centres - pixels).T) < radii_px
    height, width = image.shape
    found &= ((centres >= 0) & (centres <= [width - 1, height - 1])).all(axis=1)
    return windows, fits, found


def is_explained(windows: Windows, fits: Fits) -> NDArray[np.bool_]:
    """Whether each fit (n,) explains its window: by itself, and beside the others."""
    mean = _mean(windows.values, windows)
    total = ((windows.values - mean[:, None]) ** 2 * windows.counts).sum(axis=1)
    squares = (fits.residuals**2).sum(axis=1)
    left = squares / np.maximum(total, 1e-9)
    pixels = np.maximum(windows.counts.sum(axis=1) - fits.parameters.shape[1], 1.0)
    noise = squares / pixels
    strange = (noise > ODD_NOISE * np.median(noise)) & (left > ODD_SHARE)
    return np.asarray((left < MOST_LEFT) & ~strange)


def _mean(values: Values, windows: Windows) -> FloatArray:
    total = np.maximum(windows.counts.sum(axis=1), 1.0)
    result: FloatArray = (values * windows.counts).sum(axis=1) / total
    return result


def _moved(parameters: FloatArray, centres: FloatArray) -> FloatArray:
    result = parameters.copy()
    result[:, :2] = centres
    return result


def _with_levels(
    model: Model, contrast: int, windows: Windows, pixels: FloatArray, start: FloatArray
) -> FloatArray:
    """The start with its centre, and the contrast and mean that fit best to it."""
    result = _moved(start, pixels - windows.middle)
    result[:, contrast] = 1.0
    shape, _ = model(result.astype(np.float32), windows.offsets)
    shape_mean = _mean(shape, windows)
    centred = (shape - shape_mean[:, None]) * windows.counts
    power = np.maximum((centred**2).sum(axis=1), 1e-9)
    result[:, contrast] = (centred * windows.values).sum(axis=1) / power
    result[:, contrast + 1] = _mean(windows.values, windows) - result[:, contrast] * shape_mean
    return result


def fit(model: Model, windows: Windows, start: FloatArray) -> Fits:
    """Levenberg-Marquardt from parameters `start` (n, k), every window with its own damping."""
    parameters = start.copy()
    damping = np.full(len(start), FIRST_DAMPING)
    residuals, jacobian = _linearise(model, windows, np.arange(len(start)), parameters)
    cost = (residuals**2).sum(axis=1, dtype=float)
    moving = np.arange(len(start))
    for _ in range(ITERATIONS):
        step = _step(jacobian[moving], residuals[moving], damping[moving])
        tried, slopes = _linearise(model, windows, moving, parameters[moving] + step)
        tried_cost = (tried**2).sum(axis=1, dtype=float)
        better = tried_cost <= cost[moving]  # False where it is NaN
        now = moving[better]
        parameters[now] += step[better]
        residuals[now], jacobian[now], cost[now] = tried[better], slopes[better], tried_cost[better]
        damping[moving] = np.where(better, damping[moving] / 10, damping[moving] * 10)
        moving = moving[~(np.abs(step[:, :2]).max(axis=1) < STILL_PX)]
        if not len(moving):
            break
    return Fits(parameters, residuals, jacobian)


def _step(jacobian: Values, residuals: Values, damping: FloatArray) -> FloatArray:
    """Steps (n, k) of damped Gauss-Newton."""
    normal = np.matmul(jacobian.transpose(0, 2, 1), jacobian).astype(float)
    gradient = np.einsum("npk,np->nk", jacobian, residuals).astype(float)
    scale = np.sqrt(np.maximum(np.einsum("nkk->nk", normal), 1e-12))
    scaled = normal / (scale[:, :, None] * scale[:, None, :])
    scaled += damping[:, None, None] * np.eye(jacobian.shape[2])
    step: FloatArray = np.linalg.solve(scaled, (-gradient / scale)[..., None])[..., 0] / scale
    return step


def _linearise(
    model: Model, windows: Windows, which: NDArray[np.intp], parameters: FloatArray
) -> tuple[Values, Values]:
    """Residuals and Jacobian of the windows `which` (m,) at their parameters (m, k)."""
    with np.errstate(all="ignore"):  # a step too far is undone
        values, jacobian = model(parameters.astype(np.float32), windows.offsets)
        counts = windows.counts[which]
        residuals = (values - windows.values[which]) * counts
        slopes = jacobian * counts[..., None]
    usable = np.isfinite(residuals).all(axis=1) & (np.abs(slopes) < MOST_SLOPE).all(axis=(1, 2))
    residuals[~usable] = np.inf  # larger than any
    slopes[~usable] = 0.0
    return residuals, slopes


def centre_sigmas(fits: Fits, windows: Windows, good: NDArray[np.bool_]) -> FloatArray:
    """Sigma (n,) in px of the centres of `good` fits along their worst direction; inf of others.

    The noise is that of the residuals, with its correlation between neighbouring pixels; it
    reaches the centre through the fit's own linear map. For white noise that is the Cramer-Rao
    bound of the model.
    """
    sigma: FloatArray = np.full(len(good), np.inf)
    if not good.any():
        return sigma
    jacobian, residuals, counts = fits.jacobian[good], fits.residuals[good], windows.counts[good]
    freedom = np.maximum(counts.sum(axis=1) - jacobian.shape[2], 1.0)
    squares = (residuals**2).sum(axis=1)
    typical = float(np.median(squares / freedom))
    variance = (squares + PRIOR_PIXELS * typical) / (freedom + PRIOR_PIXELS)
    normal = np.matmul(jacobian.transpose(0, 2, 1), jacobian).astype(float)
    inverse = np.linalg.pinv(normal, hermitian=True)[:, :2].astype(np.float32)
    influence = np.matmul(jacobian, inverse.transpose(0, 2, 1))  # (n, p, 2)
    place = (windows.offsets - windows.offsets.min(axis=0)).astype(int)
    side = int(place.max()) + 1

    def gridded(values: Values) -> Values:
        grid = np.zeros((len(values), side, side, values.shape[2]), np.float32)
        grid[:, place[:, 1], place[:, 0]] = values
        return grid

    correlation = _correlation(gridded(residuals[..., None])[..., 0], gridded(counts[..., None]))
    spread = gridded(influence)
    smeared = convolve(spread, correlation[None, :, :, None], mode="constant")
    flat = spread.reshape(len(spread), -1, 2).transpose(0, 2, 1)
    covariance = np.matmul(flat, smeared.reshape(len(spread), -1, 2)).astype(float)
    covariance = (covariance + covariance.transpose(0, 2, 1)) / 2
    white = np.matmul(influence.transpose(0, 2, 1), influence).astype(float)
    worst = np.maximum(np.linalg.eigvalsh(covariance), np.linalg.eigvalsh(white))[:, -1]
    sigma[good] = np.sqrt(np.maximum(variance, QUANTISATION) * worst)
    return sigma


def _correlation(residuals: Values, counts: Values) -> Values:
    """Autocorrelation (2 LAGS + 1, 2 LAGS + 1) of residuals (n, side, side), by lag."""
    counted = counts[..., 0]
    power = max(float((residuals**2).sum() / counted.sum()), 1e-12)
    result = np.zeros((2 * LAGS + 1, 2 * LAGS + 1), np.float32)
    for down in range(LAGS + 1):
        for right in range(-LAGS, LAGS + 1):
            one, other = _shifted(residuals, down, right)
            both = np.multiply(*_shifted(counted, down, right)).sum()
            share = float((one * other).sum() / both) / power if both else 0.0
            # The same the other way.
            result[LAGS + down, LAGS + right] = result[LAGS - down, LAGS - right] = share
    return result


def _shifted(grid: Values, down: int, right: int) -> tuple[Values, Values]:
    """The parts of (n, height, width) that lie over each other when one is shifted."""
    height, width = grid.shape[1:]
    one = grid[:, down:, max(right, 0) : width + min(right, 0)]
    return one, grid[:, : height - down, max(-right, 0) : width + min(-right, 0)]
