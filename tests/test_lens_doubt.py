"""What hangs on the choice of the lens: a rival that does as well and changes the picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graphs.build import GraphOptions
from graphs.ladder import Ladder, Rung, climb
from graphs.lens_doubt import lens_doubt
from graphs.priors import weak_lens_prior
from graphs.problem import Problem
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks


@pytest.fixture(scope="module")
def ladder() -> Ladder:
    """A radial lens, seen in the middle of its image alone: what is in the corners stays open."""
    tracks = TrackOptions(
        rig="mono", frames=16, points=2500, max_points_per_image=120, lens="radial"
    )
    problem, _ = simulate_tracks(tracks, np.random.default_rng(0))
    middle = problem.initial.cameras[0].centre
    inside = np.linalg.norm(problem.observations.pixels - middle, axis=1) < 190
    problem = replace(problem, observations=problem.observations.subset(inside))

    def options_for(changed: Problem) -> GraphOptions:
        priors = tuple(weak_lens_prior(camera) for camera in changed.initial.cameras)
        return GraphOptions(lens_priors=priors)

    return climb(problem, options_for, [0], 1.0)


def with_gain(ladder: Ladder, label: str, gain_px: float) -> Ladder:
    """As if one rung had gained so much, and all others nothing, against the one that is chosen."""
    rungs = tuple(
        replace(
            rung,
            against=ladder.chosen,
            gain_px=gain_px if rung.rung.label == label else -0.01,
        )
        for rung in ladder.rungs
    )
    return replace(ladder, rungs=rungs)


@pytest.mark.slow
def test_a_rival_that_does_as_well_is_told_with_what_it_moves(ladder: Ladder) -> None:
    assert ladder.best.rung.label in ("simple_radial", "radial")
    stated = ladder.best.covariance.stated
    doubt = lens_doubt(with_gain(ladder, "brown", 0.004), stated)
    assert doubt is not None and doubt.label == "brown" and doubt.gain_px == 0.004
    brown = ladder.rungs[-1].estimate.cameras[0].named()
    chosen = ladder.best.estimate.cameras[0].named()
    for name, move, sigmas in zip(doubt.parameters, doubt.moves, doubt.moves_sigmas, strict=True):
        own = name.removeprefix("cam0.")
        assert move == pytest.approx(brown[own] - chosen[own])
        assert sigmas == pytest.approx(move / stated.sigma[name]) and abs(sigmas) > 1
    sizes = np.abs(doubt.moves_sigmas)
    assert (np.diff(sizes) <= 0).all() and len(sizes) > 0
    assert 0 < doubt.effect_px < doubt.corner_px


def test_what_loses_or_moves_nothing_is_no_rival(ladder: Ladder) -> None:
    stated = ladder.best.covariance.stated
    assert lens_doubt(with_gain(ladder, "none of them", 1.0), stated) is None
    wide = replace(stated, matrix=1e8 * stated.matrix)  # no move is worth a sigma
    assert lens_doubt(with_gain(ladder, "brown", 0.004), wide) is None
    last = replace(with_gain(ladder, "brown", 0.004), chosen=len(ladder.rungs) - 1)
    assert lens_doubt(last, stated) is None


def rivals(ladder: Ladder, *changes: tuple[float, int, float]) -> Ladder:
    """In place of the rungs above the chosen one: fx, against which rung, and the gain of each."""
    best = ladder.best
    camera = best.estimate.cameras[0]
    rungs = [replace(best, rung=Rung("simple_radial"))] * ladder.chosen + [best]
    for number, (fx, against, gain_px) in enumerate(changes):
        params = camera.params + fx * (np.arange(len(camera.params)) == 0)
        moved = replace(best.estimate, cameras=(replace(camera, params=params),))
        label = Rung("brown", (f"rival {number}",))
        rungs.append(replace(best, rung=label, estimate=moved, against=against, gain_px=gain_px))
    return replace(ladder, rungs=tuple(rungs))


def test_of_two_rivals_the_one_that_changes_the_picture_more_is_told(ladder: Ladder) -> None:
    own, stated = ladder.chosen, ladder.best.covariance.stated
    little, much = (20.0, own, 0.004), (-50.0, own, 0.001)
    for one, two, place in ((little, much, 1), (much, little, 0)):
        doubt = lens_doubt(rivals(ladder, one, two), stated)
        assert doubt is not None and doubt.label == f"brown without rival {place}"
        assert doubt.moves == pytest.approx((-50.0,)) and doubt.gain_px == 0.001


def test_who_was_compared_with_another_lens_is_no_rival(ladder: Ladder) -> None:
    own, stated = ladder.chosen, ladder.best.covariance.stated
    assert lens_doubt(rivals(ladder, (-20.0, own + 1, 0.004)), stated) is None
    doubt = lens_doubt(rivals(ladder, (-10.0, own, 0.004), (-20.0, own + 1, 0.004)), stated)
    assert doubt is not None and doubt.label == "brown without rival 0"


def test_what_a_turn_of_the_camera_undoes_is_no_change_of_the_picture(ladder: Ladder) -> None:
    """The principal point moved by a pixel is a turn but for what perspective makes of it."""
    best = ladder.best
    camera = best.estimate.cameras[0]
    params = camera.params.copy()
    params[2] += 1.0
    moved = replace(camera, params=params)
    rival = replace(
        ladder.rungs[-1],
        estimate=replace(best.estimate, cameras=(moved,)),
        covariance=best.covariance,
    )
    rungs = (*ladder.rungs[:-1], rival)
    tight = replace(best.covariance.stated, matrix=1e-6 * best.covariance.stated.matrix)
    doubt = lens_doubt(with_gain(replace(ladder, rungs=rungs), "brown", 0.004), tight)
    assert doubt is not None and doubt.parameters == ("cam0.cx",)
    assert 0.01 < doubt.effect_px < 0.35
