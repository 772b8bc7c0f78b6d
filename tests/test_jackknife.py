"""The delete-group jackknife: blocks, moves against fresh solves, and what the model expects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from synthetic.shared_errors import sheared

from graphs.build import CalibrationGraph, GraphOptions, build
from graphs.frames import FloatArray, Transform, exp_rotation
from graphs.jackknife import (
    BLOCKS,
    Jackknife,
    _of_scale,
    blocks_of,
    change,
    delete_group_jackknife,
    solve_part,
)
from graphs.model_covariance import ModelCovariance, model_covariance
from graphs.problem import Estimate, KnownPath, KnownSpan, Problem
from graphs.selection import select_tracks
from graphs.solve import solve
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

SIGMA_PX = 0.5
TRACKS = TrackOptions(
    rig="stereo", frames=20, points=1200, max_points_per_image=80, sigma_px=SIGMA_PX,
    focal_error=0.01, rotation_error_deg=0.3, translation_error_m=0.01, point_error_m=0.02,
    baseline_sigma_m=0.0,
)  # fmt: skip


def problem_of(seed: int = 0, **changes: object) -> Problem:
    return simulate_tracks(TRACKS.model_copy(update=changes), np.random.default_rng(seed))[0]


def solved(problem: Problem) -> tuple[CalibrationGraph, Estimate, ModelCovariance]:
    graph = build(problem, GraphOptions(SIGMA_PX))
    estimate, values, summary = solve(graph)
    assert summary.converged
    return graph, estimate, model_covariance(graph, estimate, values)


def jackknifed(problem: Problem) -> tuple[Jackknife, ModelCovariance]:
    graph, estimate, model = solved(problem)
    found = delete_group_jackknife(graph, estimate, model, 1.0)
    assert found is not None
    return found, model


def test_blocks_are_runs_of_frames_about_equally_long() -> None:
    problem = problem_of(frames=23)
    count = np.bincount(blocks_of(problem))
    assert len(count) == BLOCKS and count.min() == 2 and count.max() == 3
    assert (np.diff(blocks_of(problem)) >= 0).all()
    assert blocks_of(problem, 2).tolist() == [0] * 12 + [1] * 11
    for frames, sizes in ((8, [2] * 4), (7, [1] * 7), (3, [1] * 3)):
        few = replace(problem, frame_names=problem.frame_names[:frames])
        assert np.bincount(blocks_of(few)).tolist() == sizes


def test_changes_are_those_of_the_reported_parameters() -> None:
    estimate = solved(problem_of())[1]
    turn, shift = np.array([0.01, -0.02, 0.03]), np.array([0.1, 0.2, 0.3])
    cam1 = estimate.cam_from_rig[1]
    moved = Transform(exp_rotation(turn) @ cam1.rotation, cam1.translation + shift)
    lens = replace(estimate.cameras[0], params=estimate.cameras[0].params + np.arange(1, 7))
    other = replace(
        estimate,
        cameras=(lens, estimate.cameras[1]),
        cam_from_rig=(estimate.cam_from_rig[0], moved),
    )
    names = ("cam0.fx", "cam0.k2", "cam1.rotation_y", "cam1.translation_z", "cam1.cx")
    np.testing.assert_allclose(change(estimate, other, names), [1, 6, -0.02, 0.3, 0], atol=1e-12)


def test_moves_are_those_of_a_fresh_solve_without_the_block() -> None:
    """From the problem's own start, to the last digit; the unit is the baseline of each."""
    problem = problem_of()
    graph, estimate, model = solved(problem)
    found = delete_group_jackknife(graph, estimate, model, 1.0)
    assert found is not None and found.failed == () and len(found.moved) == BLOCKS
    assert found.frames[0] == ("000000", "000001")
    block = blocks_of(problem)
    for number in (0, 7):
        keep = block[problem.observations.frame] != number
        rest = select_tracks(replace(problem, observations=problem.observations.subset(keep)), 1.0)
        alone, _, _ = solve(build(rest, graph.options), relative_tolerance=1e-12)
        units = [np.linalg.norm(e.cam_from_rig[1].translation) for e in (estimate, alone)]
        expected = change(estimate.scaled(1 / units[0]), alone.scaled(1 / units[1]), model.names)
        sigma = np.sqrt(np.diag(model.matrix))
        assert np.abs((found.moved[number] - expected) / sigma).max() < 0.02
        assert np.abs(expected / sigma).max() > 0.1  # there was something to find


@pytest.mark.slow
def test_half_of_the_frames_move_by_the_difference_of_the_covariances() -> None:
    """Hausman's lemma over 16 draws of the noise: var(part - all) = var(part) - var(all)."""
    ratios = []
    for seed in range(16):
        graph, estimate, model = solved(problem_of(seed, frames=12, points=700))
        part = solve_part(graph, estimate, model, np.arange(12) < 6, 1.0)
        assert part is not None
        moved, of_part = part
        free = np.array([name != "cam1.translation_x" for name in model.names])  # the unit
        more = np.diag(of_part.matrix - model.matrix)[free]
        assert (more > 0).all()
        ratios.append(moved[free] ** 2 / more)
    assert 0.7 < np.mean(ratios) < 1.4


@pytest.mark.slow
def test_independent_noise_moves_as_the_model_expects() -> None:
    ratio = []
    for seed in range(4):
        found, model = jackknifed(problem_of(seed))
        share = np.diag(found.covariance) / np.diag(found.expected)
        ratio.append(float(np.mean(share)))
        assert (np.diag(found.covariance) > 0.3 * np.diag(model.matrix)).all()
    assert 0.75 < np.mean(ratio) < 1.2


def test_what_frames_err_together_moves_more() -> None:
    found, _ = jackknifed(sheared(problem_of(), 0.006, 0))
    plain, _ = jackknifed(problem_of())

    def beyond(jackknife: Jackknife) -> FloatArray:
        return np.diag(jackknife.covariance) / np.diag(jackknife.expected)

    assert np.median(beyond(found) / beyond(plain)) > 3


def test_too_few_frames_make_no_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graphs.jackknife.FEWEST_BLOCKS", 7)
    graph, estimate, model = solved(problem_of(frames=6, points=2000))
    assert delete_group_jackknife(graph, estimate, model, 1.0) is None


def test_a_block_without_which_nothing_is_determined_is_named() -> None:
    """Only its first four frames move; without the parallax of the rest no track is left."""
    problem = problem_of()
    graph, estimate, model = solved(problem)
    part = solve_part(graph, estimate, model, np.arange(20) < 1, 1.0)
    assert part is None
    told: list[tuple[int, int]] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "graphs.jackknife.solve_part",
            lambda g, e, m, frames, p: None if not frames[4] else solve_part(g, e, m, frames, p),
        )
        found = delete_group_jackknife(graph, estimate, model, 1.0, lambda *d: told.append(d))
    assert found is not None
    assert found.failed == (("000004", "000005"),) and len(found.moved) == BLOCKS - 1
    assert told[-1] == (BLOCKS, BLOCKS)


def test_the_ends_of_a_measured_path_stay() -> None:
    problem = problem_of()
    places = [t.inverse.translation for t in problem.initial.rig_from_world]
    length = float(np.linalg.norm(places[15] - places[3]))
    known = replace(problem, scales=(KnownPath((3, 15), length, 0.01 * length),))
    found, _ = jackknifed(known)
    assert found.failed == ()
    place = found.names.index("cam1.translation_x")
    assert np.isfinite(found.moved).all() and np.abs(found.moved[:, place]).max() < 0.05


def test_frames_of_every_measured_length_are_kept() -> None:
    problem = problem_of()
    rows = np.flatnonzero(np.isin(problem.observations.point, (5, 9)))
    clicked = set(problem.observations.frame[rows].tolist())
    scales = (
        KnownPath((3, 15), 1.0, 0.1),
        KnownSpan((5, 9), 1.0, 0.1),
        KnownPath((7, 3), 1.0, 0.1),
    )
    kept = _of_scale(replace(problem, scales=scales))
    assert set(kept.tolist()) == clicked | {3, 7, 15}
    assert _of_scale(problem).size == 0


def test_shared_lenses_move_as_one() -> None:
    problem = problem_of()
    graph = build(problem, GraphOptions(SIGMA_PX, shared_lenses=((0, 1),)))
    estimate, values, _ = solve(graph)
    model = model_covariance(graph, estimate, values)
    part = solve_part(graph, estimate, model, np.arange(20) > 3, 1.0)
    assert part is not None
    moved = dict(zip(model.names, part[0], strict=True))
    for name in estimate.cameras[0].names:
        assert moved[f"cam0.{name}"] == moved[f"cam1.{name}"] != 0


def test_a_part_takes_the_unit_of_the_whole() -> None:
    """Where the whole found no baseline worth being one, its parts have none either."""
    graph, estimate, model = solved(problem_of())
    none = replace(model, unit_camera=None, unit=1.0)
    part = solve_part(graph, estimate, none, np.arange(20) > 3, 1.0)
    assert part is not None
    assert part[1].unit_camera is None and part[1].unit == 1.0
