"""Ours beside OpenCV and mrcal: on simulated corners all agree, and what is wrong is found."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic.boards import COLUMNS, ROWS, SQUARE_M, flat_board, stereo, waved

from experiments import target_peers
from experiments.peers import mrcal, ours
from experiments.peers.calibrations import PeerCalibration, gauss_newton_covariance, residuals_of
from experiments.peers.halves import apart, projections_apart, splits, z_scores
from experiments.peers.held_out import held_out
from experiments.peers.misfit import Misfit, misfits
from experiments.peers.opencv import calibrate_camera, calibrate_pair, place_board
from experiments.peers.ours import OurOptions
from experiments.peers.sightings import (
    DATA_SETS,
    common,
    consistent,
    corners_in,
    frames_of,
    of_camera,
    of_frames,
    sightings,
)
from experiments.target_peers import PeersOptions
from graphs.boards import corners_of
from graphs.problem import Problem
from sfm_calib.boards.spec import Checkerboard
from sfm_calib.boards.views import BoardView, BoardViews

NOISE_PX = 0.1
BOARD = Checkerboard(inner_corners=(COLUMNS, ROWS), square_m=SQUARE_M)
CORNERS = BOARD.corners_m
DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def views_of(problem: Problem) -> BoardViews:
    """A problem's observations as views of its board."""
    seen, n = problem.observations, len(CORNERS)
    views = []
    for frame in range(len(problem.frame_names)):
        for camera in range(len(problem.initial.cameras)):
            rows = np.flatnonzero((seen.frame == frame) & (seen.camera == camera))
            if len(rows):
                sigma_px = np.full(len(rows), NOISE_PX)
                corner = seen.point[rows] % n
                views.append(BoardView(camera, frame, corner, seen.pixels[rows], sigma_px))
    cameras = problem.initial.cameras
    return BoardViews(
        tuple(camera.name for camera in cameras), tuple(camera.size for camera in cameras),
        problem.frame_names, tuple(views),
    )  # fmt: skip


def scene(
    n_frames: int = 10, shape: tuple[float, float, float] = (0, 0, 0), seed: int = 3
) -> tuple[BoardViews, PeerCalibration]:
    """Simulated views, and the truth."""
    problem, truth = waved(np.random.default_rng(seed), n_frames, NOISE_PX, shape=shape)
    views = common(views_of(problem))
    start = calibrate_pair(views, CORNERS, "radtan", refined=True)
    placed = dict(enumerate(truth.rig_from_world))
    return views, replace(
        start, cameras=truth.cameras, cam_from_rig=truth.cam_from_rig, rig_from_board=placed,
        shape=np.array(shape, dtype=float),
    )  # fmt: skip


@pytest.fixture(scope="module")
def views() -> BoardViews:
    return scene()[0]


@pytest.fixture(scope="module")
def pair(views: BoardViews) -> PeerCalibration:
    return calibrate_pair(views, CORNERS, "radtan", refined=True)


def test_opencv_finds_the_truth_within_its_sigmas(pair: PeerCalibration) -> None:
    truth = scene()[1]
    for name, sigma in pair.covariance.sigma.items():
        assert abs(pair.values[name] - truth.values[name]) < 4 * sigma, name
    assert pair.rms_px == pytest.approx(NOISE_PX * 2**0.5, rel=0.1)


def test_a_camera_alone_has_the_sigmas_of_gauss_newton(views: BoardViews) -> None:
    left = of_camera(views, 0)
    for lens in ("pinhole", "radial", "radtan", "brown"):
        found = calibrate_camera(left, CORNERS, lens)  # type: ignore[arg-type]
        names = found.covariance.names
        sigma = gauss_newton_covariance(found, left, CORNERS, names).sigma
        stated = found.covariance.sigma
        # A pinhole is no optimum of a lens that bends: OpenCV's rest of a gradient counts.
        np.testing.assert_allclose(
            [stated[name] for name in names], [sigma[name] for name in names], rtol=2e-3
        )


def test_a_pair_of_held_lenses_keeps_those_of_each_alone(views: BoardViews) -> None:
    found = calibrate_pair(views, CORNERS, "radtan", refined=False)
    for index in range(len(found.cameras)):
        alone = calibrate_camera(of_camera(views, index), CORNERS, "radtan")
        for name, sigma in alone.covariance.sigma.items():
            # OpenCV solves twice, and on some machines ends at another last digit.
            assert found.values[name] == pytest.approx(alone.values[name], abs=1e-4 * sigma), name
        for name in alone.covariance.names:
            assert found.covariance.sigma[name] == pytest.approx(alone.covariance.sigma[name])


def test_ours_alike_is_opencvs_optimum_and_sigma(views: BoardViews, pair: PeerCalibration) -> None:
    options = OurOptions(like_opencv=True, sigmas="model", blocks=False)
    found = ours.calibrate(views, CORNERS, pair, options)
    assert found.rms_px == pytest.approx(pair.rms_px, rel=1e-6)
    for name, sigma in pair.covariance.sigma.items():
        assert abs(found.values[name] - pair.values[name]) < 0.01 * sigma, name
        assert found.covariance.sigma[name] == pytest.approx(sigma, rel=1e-3), name


def test_ours_starts_by_pnp_where_the_start_has_no_place(
    views: BoardViews, pair: PeerCalibration
) -> None:
    options = OurOptions(like_opencv=True, blocks=False)
    lost = replace(pair, rig_from_board={})
    found = ours.calibrate(views, CORNERS, lost, options)
    assert found.rms_px == pytest.approx(pair.rms_px, rel=1e-6)


@pytest.mark.slow
def test_a_bent_board_is_found_bent_and_predicts_better() -> None:
    bend = 0.002
    seen, _ = scene(shape=(0.0, bend, 0.0))
    start = calibrate_pair(seen, CORNERS, "radtan", refined=True)
    options = OurOptions(like_opencv=True, bend_sigma=0.02, blocks=False)
    found = ours.calibrate(seen, CORNERS, start, options)
    sigma = ours.with_bends_sigma(found, seen, CORNERS)
    assert found.values["board.bend_x"] == pytest.approx(bend, abs=4 * sigma["board.bend_x"])
    assert bend > 10 * sigma["board.bend_x"]
    assert abs(found.values["board.bend_y"]) < 4 * sigma["board.bend_y"]

    def bent(part: BoardViews) -> PeerCalibration:
        return ours.calibrate(part, CORNERS, start, options)

    def flat(part: BoardViews) -> PeerCalibration:
        return calibrate_pair(part, CORNERS, "radtan", refined=True)

    less, error = held_out(seen, CORNERS, bent, 3).less(held_out(seen, CORNERS, flat, 3))
    assert less < -2 * error


def test_a_wide_belief_in_tangential_terms_lets_them_go(
    views: BoardViews, pair: PeerCalibration
) -> None:
    (lens,) = {camera.lens for camera in pair.cameras}
    assert lens == "radtan"
    usual, wide = (
        ours.believing(pair.cameras[0], OurOptions(tangential_sigma=sigma)).sigma
        for sigma in (None, 0.01)
    )
    np.testing.assert_array_equal(wide != usual, [*[False] * 6, True, True])
    np.testing.assert_array_equal(wide[6:], 0.01)


def test_held_out_frames_are_predicted_to_the_noise(views: BoardViews) -> None:
    asked: list[list[int]] = []

    def calibrate(part: BoardViews) -> PeerCalibration:
        asked.append(frames_of(part))
        return calibrate_pair(part, CORNERS, "radtan", refined=True)

    found = held_out(views, CORNERS, calibrate, 5)
    assert len(asked) == 5 and all(len(frames) == 8 for frames in asked)
    assert len(found.lengths_px) == sum(len(view.corner) for view in views.views)
    assert found.rms_px == pytest.approx(NOISE_PX * 2**0.5, rel=0.1)
    assert found.median_px == pytest.approx(NOISE_PX * (2 * np.log(2)) ** 0.5, rel=0.1)
    assert found.less(found) == (0.0, 0.0)


def test_halves_lie_as_far_apart_as_their_sigmas_say(views: BoardViews) -> None:
    ratio, z = [], []
    for halves in splits(frames_of(views), 4):
        assert sorted([*halves[0], *halves[1]]) == frames_of(views)
        a, b = (
            calibrate_pair(of_frames(views, half), CORNERS, "radtan", refined=True)
            for half in halves
        )
        z += list(z_scores(a, b).values())
        ratio += [each.rms_px / each.expected_px for each in (apart(a, b, 0), apart(a, b, 1))]
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.6
    assert 0.4 < np.sqrt(np.mean(np.square(ratio))) < 1.8


def test_a_turn_of_the_camera_is_no_difference(pair: PeerCalibration) -> None:
    camera = pair.cameras[0]
    assert projections_apart(camera, camera) == pytest.approx(0.0, abs=1e-6)
    shifted = replace(camera, params=camera.params + np.array([0, 0, 1.0, 0, *[0] * 4]))
    longer = replace(camera, params=camera.params * np.array([1.01, 1.01, *[1] * 6]))
    assert projections_apart(camera, shifted) < 0.3 < 1 < projections_apart(camera, longer)


def cause(found: list[Misfit], name: str) -> Misfit:
    return next(each for each in found if each.cause == name)


def test_noise_alone_is_no_misfit(views: BoardViews, pair: PeerCalibration) -> None:
    for each in misfits(pair, views, CORNERS):
        assert each.p_value > 1e-3, each


def test_a_bend_and_rolling_rows_are_told_apart(views: BoardViews) -> None:
    bent, _ = scene(shape=(0.0, 0.002, 0.0))
    found = misfits(calibrate_pair(bent, CORNERS, "radtan", True), bent, CORNERS)
    assert cause(found, "board bent").f > 100 * cause(found, "rows of an image shifted").f
    rng, rolled = np.random.default_rng(0), []
    for view in views.views:
        rows = (view.pixels[:, 1] - 240)[:, None] / 100
        rolled.append(replace(view, pixels=view.pixels + rows * rng.normal(0, 0.2, 2)))
    moving = replace(views, views=tuple(rolled))
    found = misfits(calibrate_pair(moving, CORNERS, "radtan", True), moving, CORNERS)
    rows_f = cause(found, "rows of an image shifted").f
    assert rows_f > 5 and rows_f > 2 * cause(found, "board bent").f


@pytest.mark.parametrize("columns", [COLUMNS, 7])
def test_half_turns_between_cameras_are_undone(columns: int) -> None:
    board = Checkerboard(inner_corners=(COLUMNS, ROWS), square_m=SQUARE_M)
    seen, truth = scene(8)
    whole = {}
    for view in seen.views:
        whole.setdefault(view.frame, []).append(len(view.corner) == len(CORNERS))
    seen = of_frames(seen, [frame for frame, full in whole.items() if all(full)])
    if columns != COLUMNS:  # an odd sum of corners looks like itself one way round only
        asked = Checkerboard(inner_corners=(columns, ROWS), square_m=SQUARE_M)
        placed = [truth.rig_from_board[view.frame] for view in seen.views]
        assert consistent(seen, asked, placed) == (seen, 0)
        return
    turned_frames = set(frames_of(seen)[1::3])
    turned = replace(seen, views=tuple(
        replace(view, pixels=view.pixels[::-1])
        if view.camera == 1 and view.frame in turned_frames else view
        for view in seen.views
    ))  # fmt: skip
    placed = [place_board(truth.cameras[view.camera], view, CORNERS) for view in turned.views]
    mended, count = consistent(turned, board, placed)
    assert count == len(turned_frames) > 0
    for view, wanted in zip(mended.views, seen.views, strict=True):
        np.testing.assert_array_equal(view.corner, wanted.corner)
        np.testing.assert_array_equal(view.pixels, wanted.pixels)


def test_corners_of_a_drawn_board_are_found() -> None:
    side, size = 40, (COLUMNS + 1, ROWS + 1)
    x, y = np.meshgrid(np.arange(size[0] * side), np.arange(size[1] * side))
    image = np.where((x // side + y // side) % 2, 255, 0).astype(np.uint8)
    image = np.pad(image, side, constant_values=255)
    found = corners_in(image, BOARD)
    assert found is not None
    wanted = CORNERS[:, :2] / SQUARE_M * side + 2 * side - 0.5
    either = min(np.abs(found - wanted).max(), np.abs(found[::-1] - wanted).max())
    assert either < 0.2
    assert corners_in(np.full((200, 200), 128, np.uint8), BOARD) is None


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="left has no images"):
        sightings(tmp_path, DATA_SETS["opencv_stereo"])


needs_mrcal = pytest.mark.skipif(mrcal.why_not() is not None, reason=str(mrcal.why_not()))


@needs_mrcal
@pytest.mark.parametrize("bends", [False, True])
def test_mrcal_ends_where_we_do(bends: bool) -> None:
    seen, _ = scene(shape=(0.0, 0.002 * bends, -0.001 * bends))
    start = calibrate_pair(seen, CORNERS, "radtan", refined=True)
    alike = mrcal.MrcalOptions(bends=bends, reject=False, regularise=False)
    theirs = mrcal.calibrate(seen, BOARD, start, alike)
    options = OurOptions(like_opencv=True, bend_sigma=1.0 * bends, sigmas="model", blocks=False)
    found = ours.calibrate(seen, CORNERS, start, options)
    for name, sigma in found.covariance.sigma.items():
        assert abs(found.values[name] - theirs.values[name]) < 0.02 * sigma, name
        assert theirs.covariance.sigma[name] == pytest.approx(sigma, rel=0.01), name
    if bends:
        own = ours.with_bends_sigma(found, seen, CORNERS)
        for name, sigma in own.items():
            assert found.values[name] == pytest.approx(theirs.values[name], abs=0.02 * sigma)
            assert theirs.covariance.sigma[name] == pytest.approx(sigma, rel=0.01)
    assert len(theirs.at_infinity_px) == len(theirs.near_px) == 2
    assert all(0 < px < 5 for px in (*theirs.at_infinity_px, *theirs.near_px))


@needs_mrcal
def test_mrcals_failure_is_in_its_own_words(views: BoardViews, pair: PeerCalibration) -> None:
    broken = replace(pair, cam_from_rig=pair.cam_from_rig[:1])
    with pytest.raises(RuntimeError, match="mrcal failed: "):
        mrcal.calibrate(views, BOARD, broken)


def test_mrcal_is_left_out_with_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mrcal, "why_not", lambda: "it is not here")
    programs, why_not = target_peers.programs_of(BOARD, "radtan")
    assert why_not == "it is not here" and not any("mrcal" in name for name in programs)
    monkeypatch.setattr(mrcal, "why_not", lambda: None)
    programs, why_not = target_peers.programs_of(BOARD, "radtan")
    assert why_not is None and {"mrcal", "mrcal, alike"} < set(programs)
    assert target_peers.programs_of(BOARD, "radial")[1] == "it has no such lens"


@pytest.mark.slow
def test_the_tables_show_programs_side_by_side(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    few, _ = scene(6)
    programs, _ = target_peers.programs_of(BOARD, "radtan")
    chosen = {name: programs[name] for name in (target_peers.REFERENCE, "ours, alike")}
    corridor = replace(DATA_SETS["corridor_stereo"], board=BOARD)
    monkeypatch.setitem(target_peers.DATA_SETS, "simulated", corridor)
    monkeypatch.setattr(target_peers, "numbered", lambda *_: (few, 0))
    monkeypatch.setattr(target_peers, "programs_of", lambda *_: (chosen, "it is not here"))
    rows = target_peers.main(PeersOptions(("simulated",), lens="radtan", folds=2, random_halves=1))
    opencv, own = (rows["simulated"][name] for name in chosen)
    assert own.held_out.rms_px == pytest.approx(opencv.held_out.rms_px, rel=0.01)
    assert [len(own.apart), len(own.z)] == [2, 2]
    printed = capsys.readouterr().out
    for words in ("left.fx", "board bent", "ours, alike", "without mrcal: it is not here"):
        assert words in printed


def test_the_simulated_corners_are_the_boards() -> None:
    np.testing.assert_allclose(flat_board().corners, CORNERS)
    np.testing.assert_allclose(corners_of(flat_board(), np.zeros(3))[0], CORNERS)
    assert len(stereo()[0]) == 2


@pytest.mark.slow
def test_real_pairs_end_where_opencv_does() -> None:
    """What the data's own README says of them; the same optimum to a hundredth of a sigma."""
    wanted = {"corridor_stereo": (690.5, 687.5), "opencv_stereo": (534.0, 534.0)}
    for name, focal_px in wanted.items():
        if not (DATA / name).exists():
            pytest.skip(f"../shared/data/{name} is not on this machine")
        seen, _ = target_peers.numbered(DATA, DATA_SETS[name], "brown")
        corners = DATA_SETS[name].board.corners_m
        start = calibrate_pair(seen, corners, "brown", refined=True)
        alike = OurOptions(like_opencv=True, blocks=False, sigmas="model")
        found = ours.calibrate(seen, corners, start, alike)
        for key, sigma in start.covariance.sigma.items():
            assert abs(found.values[key] - start.values[key]) < 0.02 * sigma, key
        alone = calibrate_pair(seen, corners, "brown", refined=False)
        for camera, focal in zip(alone.cameras, focal_px, strict=True):
            assert camera.params[0] == pytest.approx(focal, rel=0.005)
        assert max(np.abs(r).max() for r in residuals_of(found, seen, corners)) < 3.0
