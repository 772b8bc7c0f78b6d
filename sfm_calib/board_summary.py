"""What is said of the board that took part in a calibration."""

from __future__ import annotations

from collections import Counter

import numpy as np

from graphs.board_shape import shape_sigmas
from graphs.boards import N_WHOLE, shape_of
from graphs.jackknife import change
from graphs.problem import images_seen
from sfm_calib.board_record import BoardResult, Without
from sfm_calib.run import Run


def board_result(run: Run) -> BoardResult | None:
    """The record; None where no board was used."""
    use, problem, estimate = run.board, run.refinement.problem, run.refinement.estimate
    if use is None or problem.board is None:
        return None
    names = [camera.name for camera in estimate.cameras]
    corners = problem.observations.subset(problem.known[problem.observations.point])
    images = Counter(images_seen(corners)[:, 0].tolist())
    shape = shape_of(estimate, problem.board.board)
    sigma = shape_sigmas(
        run.refinement.graph, estimate, run.refinement.values, run.covariance.inflation
    )
    whole = slice(1, N_WHOLE)
    held = problem.board.board.shape_sigma[whole] == 0
    # the solver holds a bend by a tiny sigma, and leaves a trace of it
    bend_m = np.where(held, problem.board.board.shape_mean[whole], shape[whole])
    bends, of_bends = 1e3 * np.exp(shape[0]) * bend_m, 1e3 * sigma[whole]
    off = shape[N_WHOLE:].reshape(-1, 3)
    return BoardResult(
        description=use.board.described,
        n_images={name: images[index] for index, name in enumerate(names)},
        n_corners={name: int((corners.camera == index).sum()) for index, name in enumerate(names)},
        sigma_px={names[one.camera]: one.sigma_px for one in run.refinement.noise if one.of_board},
        in_scan=use.in_scan,
        size=float(np.exp(shape[0])),
        sigma_size=float(sigma[0] * np.exp(shape[0])),
        bend_mm=(float(bends[0]), float(bends[1])),
        sigma_bend_mm=(
            0.0 if held[0] else float(of_bends[0]),
            0.0 if held[1] else float(of_bends[1]),
        ),
        corners_off_mm=1e3 * float(np.sqrt((off**2).sum(1).mean())) if len(off) else 0.0,
        left_out=use.left_out,
        repeated=use.repeated,
        without=_without(run),
    )


def _without(run: Run) -> dict[str, Without]:
    """What the scan alone says of each parameter, beside what the board moved."""
    alone = None if run.board is None else run.board.without
    if alone is None:
        return {}
    names, metric = alone.covariance.stated.names, alone.covariance.basis.unit_camera is None
    before = alone.estimate
    after = run.refinement.estimate
    moved = dict(zip(names, change(before, after, names).tolist(), strict=True))
    found = {}
    for name, sigma in alone.covariance.stated.sigma.items():
        comparable = metric or ".translation_" not in name
        found[name] = Without(
            sigma=sigma if comparable else None, moved=moved[name] if comparable else None
        )
    return found
