"""The patches of tracks aligned to each other: least-squares matching of all views at once.

Each view's patch is warped by an affine change of the reference's samples, its brightness scaled
and shifted, until it is like the mean of its track's patches (Gruen, Adaptive least squares
correlation, 1985; of many views: Gruen and Baltsavias, 1988). The gradients are the mean's, so that
a step costs one look at each image (Baker and Matthews, IJCV 2004, the inverse composition), and
the noise of one image does not bend them. Samples that differ much from the mean, as what stands
before a surface or shines on it does, count less.

The mean includes the reference, which moves with the others: where a track's patches lie on its
surface is a matter of taste, and the scene point follows.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from graphs.frames import FloatArray
from graphs.problem import IntArray
from sfm_calib.patches.crops import LEVELS, SIDE, Crops
from sfm_calib.patches.sensor_noise import A_PIXEL, doubling, shared_noise
from sfm_calib.patches.warps import HALF, monomials

if TYPE_CHECKING:
    from torch import Tensor

STEPS = 8  # four or five bring nine in ten to rest
AT_REST = 0.008  # samples: a fifth of what noise leaves, and the next step is far smaller
MOST_SHIFT, MOST_AFFINE = 1.0, 0.15  # a step, in samples and per sample
LEAST_LIKE = 0.6  # correlation of a view that counts in the mean
# From where it began, in samples: what lies farther away and looks alike is another thing.
MOST_WANDERED = 3.0
# Residuals this many times the rms of their view count half: few of its samples may differ.
ODD = 6.0**0.5
# Of Gaussian noise, whose squares so weighed are 0.80 of its variance, shifts then have 1.05 times
# that of least squares (Huber's formula), and 1.02 times by their weights: 1.05 / (1.02 * 0.80).
OF_WEIGHED = 1.28
AFFINE_PRIOR = 0.25  # sigma: surfaces slope, but what shears a patch into a line is an edge's slide
LEAST_CONTRAST = 0.5  # grey levels: sensor noise alone has more
WIDTH = 2 * HALF + 1


@dataclass(frozen=True)
class Aligned:
    """Where a batch's patches came to lie."""

    pixels: FloatArray  # (n, 2) from the middles, in image pixels
    cov_px: FloatArray  # (n, 2, 2) of each by itself, from its image's noise
    linear: FloatArray  # (n, 2, 2) affine change of the reference's samples
    likeness: FloatArray  # (n,) correlation with the mean of the other views


class _Batch:
    """Tensors of one batch, and what is computed of them."""

    def __init__(self, torch: Any, crops: Crops, track: IntArray, device: str) -> None:
        def tensor(values: NDArray[Any]) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values)).to(device, torch.float32)

        self.torch = torch
        between = tensor(doubling(SIDE))
        # Of those rows that `look` is asked for next.
        self.images = (between @ tensor(crops.pixels) @ between.T)[:, None]
        self.edges = tensor(crops.inside)
        self.middle, self.warp = tensor(crops.middle), tensor(crops.coefficients)
        self.track = torch.from_numpy(np.unique(track, return_inverse=True)[1]).to(device)
        self.n_tracks = int(self.track.max()) + 1
        ends = np.arange(-HALF - 1.0, HALF + 2.0)  # one sample wider: for the gradients
        x, y = (one.ravel() for one in np.meshgrid(ends, ends))
        self.grid, self.terms = tensor(np.column_stack([x, y])), tensor(monomials(x, y))
        self.corners = torch.tensor([0, WIDTH + 1, -WIDTH - 2, -1], device=device)
        self.samples = self.grid[(self.grid.abs() <= HALF).all(1)]
        self.window = torch.exp(-(self.samples**2).sum(1) / (2 * HALF**2))
        n = len(track)
        self.shift = torch.zeros(n, 2, device=device)
        self.linear = torch.eye(2, device=device).repeat(n, 1, 1)
        self.values = torch.zeros(n, len(self.grid), device=device)
        self.seen = torch.zeros(n, len(self.grid), device=device)
        self.use = torch.ones(n, device=device)  # of each view in the mean
        self.seed = torch.zeros(n, dtype=torch.bool, device=device)  # `begin` chooses them

    def look(self, rows: Tensor) -> None:
        """Sample the images of these rows where their patches lie now, brightness normalised."""
        warp = self.warp[rows] @ self.moved_monomials(rows)
        at = self.middle[rows, None] + self.terms @ warp.mT
        values = self.torch.nn.functional.grid_sample(
            self.images, (4 * at[:, None] + 1) / (2 * SIDE - 1) - 1,
            mode="bicubic", padding_mode="border", align_corners=False,
        )[:, 0, 0]  # fmt: skip
        low, high = self.edges[rows].unbind(1)
        edge = at[:, self.corners]
        part = ((edge < low[:, None]) | (edge > high[:, None])).any(-1).any(-1)
        seen = self.torch.ones_like(values)
        some = at[part]
        seen[part] = ((some >= low[part, None]) & (some <= high[part, None])).all(-1).float()
        mean, deviation = _moments(self.within(values), self.window * self.within(seen))
        self.values[rows] = (values - mean) / deviation.clamp(min=LEAST_CONTRAST)
        self.seen[rows] = seen

    def moved_monomials(self, rows: Tensor) -> Tensor:
        """Matrices (n, 6, 6): monomials of samples after the affine change, by those before."""
        torch = self.torch
        (sx, sy), (a, b, c, d) = self.shift[rows].T, self.linear[rows].reshape(-1, 4).T
        nil, one = torch.zeros_like(sx), torch.ones_like(sx)
        lines = [
            [one, nil, nil, nil, nil, nil],
            [sx, a, b, nil, nil, nil],
            [sy, c, d, nil, nil, nil],
            [sx * sx, 2 * sx * a, 2 * sx * b, a * a, 2 * a * b, b * b],
            [sx * sy, sx * c + sy * a, sx * d + sy * b, a * c, a * d + b * c, b * d],
            [sy * sy, 2 * sy * c, 2 * sy * d, c * c, 2 * c * d, d * d],
        ]
        return torch.stack([torch.stack(line, -1) for line in lines], 1)

    def within(self, values: Tensor) -> Tensor:
        """Of values (n, k) on the wider grid those of the patch itself."""
        wide = values.view(len(values), WIDTH + 2, WIDTH + 2)
        return wide[:, 1:-1, 1:-1].reshape(len(values), -1)

    def mean(self) -> Tensor:
        """Mean patch (n_tracks, n) of the views that count, on the wider grid."""
        torch = self.torch
        weight = self.seen * self.use[:, None]
        zero = torch.zeros(self.n_tracks, len(self.grid), device=weight.device)
        total = zero.index_add(0, self.track, weight)
        return zero.index_add(0, self.track, weight * self.values) / total.clamp(min=1e-6)

    def others(self) -> Tensor:
        """How many other views of its track count in the mean, for each (n,)."""
        return self.of_track(self.use)[self.track] - self.use

    def of_track(self, values: Tensor) -> Tensor:
        """Sums (n_tracks,) of values (n,)."""
        zero = self.torch.zeros(self.n_tracks, device=values.device)
        return zero.index_add(0, self.track, values)

    def share(self) -> Tensor:
        """How much of its track's mean each view is (n,)."""
        return self.use / (self.others() + self.use).clamp(min=1)

    def design(self, mean: Tensor) -> Tensor:
        """How the mean (n_tracks, n) changes by shift, affine change, brightness and contrast."""
        from kornia.filters import spatial_gradient

        side = WIDTH + 2
        slopes = spatial_gradient(mean.view(-1, 1, side, side), mode="diff")[:, 0]
        slopes = slopes[..., 1:-1, 1:-1].reshape(len(mean), 2, -1)
        x, y = (self.samples / HALF).T
        by_x, by_y = slopes[:, 0], slopes[:, 1]
        inner = self.within(mean)
        columns = [by_x, by_y, by_x * x, by_x * y, by_y * x, by_y * y]
        return self.torch.stack([*columns, self.torch.ones_like(inner), inner], -1)

    def fit(self, rows: Tensor, mean: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Design (n, k, 8) of rows, residuals and weights (n, k), mean squared residuals (n,)."""
        track = self.track[rows]
        inner = self.within(mean)[track]
        residual = self.within(self.values[rows]) - inner
        weight = self.window * self.within(self.seen[rows])
        square = (residual**2 * weight).sum(1) / weight.sum(1).clamp(min=1e-6)
        weight = weight / (1 + residual**2 / (ODD**2 * square[:, None] + 1e-12))
        used = (residual**2 * weight).sum(1) / weight.sum(1).clamp(min=1e-6)
        return self.design(mean)[track], residual, weight, used

    def normal(self, rows: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
        """Normal equations (n, 8, 8), (n, 8) of rows."""
        J, residual, weight, square = self.fit(rows, mean)
        weighted = J * weight[..., None]
        H, held = weighted.mT @ J, self.held(square)
        g = (weighted.mT @ residual[..., None])[..., 0]
        H.diagonal(dim1=1, dim2=2).add_(held + 1e-6)
        change = self.linear[rows] - self.torch.eye(2, device=H.device)
        g[:, 2:6] += held[:, 2:6] * HALF * change.reshape(-1, 4)
        return H, g

    def held(self, square: Tensor) -> Tensor:
        """What is believed beforehand (n, 8), in units of the mean squared residuals (n,)."""
        affine = self.torch.tensor([0.0, 0, 1, 1, 1, 1, 0, 0], device=square.device)
        return affine * square[:, None].clamp(min=1e-3) / (AFFINE_PRIOR * HALF) ** 2

    def cov_shift(self, rows: Tensor, mean: Tensor, px: FloatArray) -> Tensor:
        """Covariance (n, 2, 2) of shifts in samples, of the noise of each image; px (n,) of crops.

        How each sample moves its patch, times what noise every two of them share.
        """
        torch = self.torch
        J, _, weight, square = self.fit(rows, mean)
        H, held = ((J * weight[..., None]).mT @ J).double(), self.held(square)
        H.diagonal(dim1=1, dim2=2).add_(held + 1e-6)
        moves = torch.linalg.inv(H)[:, :2].float()  # (n, 2, 8)
        each = (moves @ J.mT * weight[:, None]).view(-1, 2, WIDTH, WIDTH)
        spacing = (self.warp[rows, :, 1:3] @ self.linear[rows]).norm(dim=1)  # (n, 2) crop px
        level = torch.from_numpy(np.log2(px).round().astype(np.int64)).to(spacing.device)
        alike = self.alike(spacing, level)
        spread = alike[:, 1, None] @ each @ alike[:, 0, None]
        from_noise = each.flatten(2) @ spread.flatten(2).mT
        believed = moves * held[:, None] @ moves.mT
        own = OF_WEIGHED * square / (1 - self.share()[rows]).clamp(min=0.1)
        return ((from_noise + believed) * own[:, None, None]).double()

    def alike(self, spacing: Tensor, level: Tensor) -> Tensor:
        """Correlations (n, 2, WIDTH, WIDTH) of samples' noise along both axes of a patch."""
        torch = self.torch
        table = torch.from_numpy(shared_noise(LEVELS + 1)).to(spacing)
        lag = torch.arange(WIDTH, device=spacing.device)
        lag = (lag[:, None] - lag).abs() * spacing[..., None, None]
        index = (lag * A_PIXEL).round().long().clamp(max=table.shape[1] - 1)
        return table[level[:, None, None, None], index]

    def likeness(self, mean: Tensor) -> Tensor:
        """Correlation (n,) of each view with the mean of the others of its track.

        0 where there are none, and where it wandered off.
        """
        share, inner = self.share()[:, None], self.within(self.values)
        others = self.within(mean)[self.track] - share * inner
        weight = self.window * self.within(self.seen)
        centre, deviation = _moments(others, weight)
        own, own_deviation = _moments(inner, weight)
        product = ((others - centre) * (inner - own) * weight).sum(1, keepdim=True)
        product /= weight.sum(1, keepdim=True).clamp(min=1e-6)
        like = (product / (deviation * own_deviation).clamp(min=1e-9))[:, 0]
        near = self.shift.norm(dim=1) <= MOST_WANDERED
        return self.torch.where(near & (self.others() > 0), like, 0.0)

    def step(self, rows: Tensor, mean: Tensor, first: bool) -> Tensor:
        """Move rows once; how far each moved, in samples."""
        torch = self.torch
        H, g = self.normal(rows, mean)
        # All views move at once: to where the mean is now, though each is a part of it.
        step = torch.linalg.solve(H, g)
        shift = step[:, :2].clamp(-MOST_SHIFT, MOST_SHIFT)
        affine = (step[:, 2:6] / HALF).clamp(-MOST_AFFINE, MOST_AFFINE).view(-1, 2, 2)
        if first:  # the mean is the seed itself
            shift = torch.where(self.seed[rows, None], 0.0, shift)
        inverse = torch.linalg.inv(torch.eye(2, device=affine.device) + affine)
        self.linear[rows] = self.linear[rows] @ inverse
        self.shift[rows] -= (self.linear[rows] @ shift[..., None])[..., 0]
        return torch.maximum(shift.abs().amax(1), HALF * affine.abs().amax((1, 2)))

    def begin(self) -> None:
        """Let the view that is most like the mean of all be the first mean: none that is hidden."""
        torch = self.torch
        like = self.likeness(self.mean())
        best = torch.full((self.n_tracks,), -2.0, device=like.device)
        best = best.scatter_reduce(0, self.track, like, "amax")
        row = torch.arange(len(like), device=like.device)
        none = len(like)
        first = torch.full((self.n_tracks,), none, device=like.device)
        candidates = torch.where(like == best[self.track], row, none)
        first = first.scatter_reduce(0, self.track, candidates, "amin")
        self.seed = row == first[self.track]
        self.use = self.seed.float()

    def count_in(self, mean: Tensor) -> None:
        """Let the views that are like the others form the mean; the seed where none are."""
        alone = (self.use > 0) & (self.others() == 0)  # nothing yet to be like
        like = ((self.likeness(mean) > LEAST_LIKE) | alone).float()
        few = self.of_track(like)[self.track] < 2
        self.use = self.torch.where(few, self.seed.float(), like)


def _moments(values: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted mean and standard deviation (n, 1) of values (n, k)."""
    total = weight.sum(1, keepdim=True).clamp(min=1e-6)
    mean = (values * weight).sum(1, keepdim=True) / total
    return mean, ((values - mean) ** 2 * weight).sum(1, keepdim=True).div(total).sqrt()


def align(torch: Any, crops: Crops, track: IntArray, device: str = "cpu") -> Aligned:
    """Align the patches of whole tracks; track (n,) of each.

    A view that shows nothing, or nothing like the others, comes out with little likeness.
    """
    with torch.inference_mode():  # a setting of each thread
        batch = _Batch(torch, crops, track, device)
        moving = torch.arange(len(track), device=device)
        for number in range(STEPS):
            batch.look(moving)
            if number:
                batch.count_in(batch.mean())
            else:
                batch.begin()
            mean = batch.mean()
            moved = batch.step(moving, mean, first=number == 0)
            if number > 1:
                going_on = moved > AT_REST
                moving, batch.images = moving[going_on], batch.images[going_on]
                if not len(moving):
                    break
        return _aligned(batch, crops)


def _aligned(batch: _Batch, crops: Crops) -> Aligned:
    every = batch.torch.arange(len(batch.track), device=batch.track.device)
    mean = batch.mean()
    x, y = shift = batch.shift.double().cpu().numpy().T
    by_sample = np.zeros((len(x), 6, 2))  # of the monomials
    by_sample[:, 1, 0] = by_sample[:, 2, 1] = 1.0
    by_sample[:, 3, 0], by_sample[:, 5, 1] = 2 * x, 2 * y
    by_sample[:, 4, 0], by_sample[:, 4, 1] = y, x
    linear = batch.linear.double().cpu().numpy()
    warp = crops.coefficients * crops.px[:, None, None]
    by_shift = warp @ by_sample @ linear
    return Aligned(
        (warp @ monomials(*shift)[..., None])[..., 0],
        by_shift @ batch.cov_shift(every, mean, crops.px).cpu().numpy() @ by_shift.mT,
        linear,
        batch.likeness(mean).cpu().numpy(),
    )
