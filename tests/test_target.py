"""Calibration from a board, end to end: rendered images in, lenses and a metric rig out."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic.targets import (
    CHARUCO,
    CHECKERBOARD,
    LEFT,
    PLACES,
    RIGHT,
    Eye,
    folder_of,
    image_of,
    in_view,
    views_of,
    without_board,
)

from graphs.camera import Camera
from graphs.frames import Transform, log_rotation
from sfm_calib.boards.load import board_yaml
from sfm_calib.cache import Cache
from sfm_calib.cli import main
from sfm_calib.config import RigConfig, TargetOptions
from sfm_calib.result import CameraResult, CamFromRig, load_calibration, save_calibration, truth
from sfm_calib.target import calibrate_target

Calibrated = tuple[Path, str]  # OUT, and what was printed
STEREO = {name: replace(eye.smaller(0.6), distortion=(eye.distortion[0], 0, 0, 0))
          for name, eye in (("left", LEFT), ("right", RIGHT))}  # fmt: skip
N_PAIRS = 5  # then one that the right camera does not see, and one that it sees later


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with `mono` and `stereo`, and a board for each."""
    root = tmp_path_factory.mktemp("target")
    folder_of(root / "mono", {"": views_of(CHECKERBOARD, LEFT)})
    held = CHECKERBOARD.model_copy(update={"warp": False, "square_sigma_m": 3e-5})
    (root / "mono.yaml").write_text(board_yaml(held))
    left, right = STEREO.values()
    moved = in_view(CHARUCO, (0.5, 0.4, 0.45, (20, 15, -20)))
    folder_of(
        root / "stereo",
        {
            "left": views_of(CHARUCO, left),
            "right": [
                *views_of(CHARUCO, right, PLACES[:N_PAIRS], seed=1),
                without_board(right.size),
                image_of(CHARUCO, right, moved, np.random.default_rng(2)),
            ],
        },
    )
    (root / "stereo.yaml").write_text(board_yaml(CHARUCO))
    cameras = [
        Camera(name, "radtan", eye.size, np.array(list(eye.truth.values())))
        for name, eye in STEREO.items()
    ]
    true = truth(cameras, [eye.cam_from_rig for eye in STEREO.values()], "")
    save_calibration(true, root / "truth.json")
    return root


def command(images: Path, name: str, out: Path, *more: str) -> list[str]:
    board = str(images / f"{name}.yaml")
    return ["target", str(images / name), "--board", board, "-o", str(out), *more]


@pytest.fixture(scope="module")
def run_of(images: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Calibrated]:
    """Runs the command line, each set of arguments once."""
    done: dict[tuple[str, ...], Calibrated] = {}

    def run(name: str, *more: str) -> Calibrated:
        if (name, *more) not in done:
            out = tmp_path_factory.mktemp("out") / "new" / "out"
            with contextlib.redirect_stdout(io.StringIO()) as text:
                assert main(command(images, name, out, *more)) == 0
            done[name, *more] = out, text.getvalue()
        return done[name, *more]

    return run


MONO = ("mono", "--lens", "radtan")


def lens_off(camera: CameraResult, eye: Eye) -> np.ndarray:
    """Every parameter's error, in its stated sigmas."""
    true = eye.truth
    assert all(value == 0 for name, value in true.items() if name not in camera.params)
    return np.array([(camera.params[p] - true[p]) / camera.sigma[p] for p in camera.params])


def place_off(found: CamFromRig, true: Transform) -> np.ndarray:
    """The rotation's and the translation's error (6,), in their stated sigmas."""
    ours = Transform.from_wxyz(found.rotation_wxyz, found.translation)
    turn_deg = np.degrees(log_rotation(ours.rotation @ true.rotation.T))
    moved = ours.translation - true.translation
    sigma = [*found.sigma_rotation_deg, *found.sigma_translation]
    return np.concatenate([turn_deg, moved]) / np.array(sigma)


# ---- one camera --------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_lens_is_right_within_its_sigmas(run_of):
    out, _ = run_of(*MONO)
    calibration = load_calibration(out / "calibration.json")
    (camera,) = calibration.cameras.values()
    assert camera.lens == "radtan" and camera.size == (640, 480) and camera.n_images == 7
    assert np.abs(lens_off(camera, LEFT)).max() < 4
    assert max(camera.sigma["fx"], camera.sigma["cx"]) < 1  # they say something
    assert not calibration.rig.metric and calibration.verdict.usable
    assert calibration.solve.rms_px < 0.1
    assert set(calibration.provenance.input_hashes) == {f"{n:02d}.png" for n in range(7)}


def test_what_was_written_and_printed(run_of, images):
    out, text = run_of(*MONO)
    assert sorted(path.name for path in out.iterdir()) == ["calibration.json", "report.html"]
    said = load_calibration(out / "calibration.json").provenance
    assert said.command == f"sfm-calib {' '.join(command(images, 'mono', out, *MONO[1:]))}"
    assert said.config["lens"] == "radtan"
    for part in (
        "radtan, 640 x 480 px, 7 images",
        "board: a checkerboard of 8 x 5 inner corners, in images of its own: camera 7 images",
        "note: only 7 frames",
        "report.html written",
    ):
        assert part in text


def test_a_board_that_is_flat_is_held_flat(run_of):
    out, text = run_of(*MONO)
    board = load_calibration(out / "calibration.json").board
    assert board is not None
    assert board.description == "a checkerboard of 8 x 5 inner corners"
    assert board.bend_mm == (0, 0) and board.sigma_bend_mm == (0, 0)
    assert board.sigma_size == pytest.approx(1e-3, rel=1e-3)  # one camera: as it is stated
    assert board.n_images == {"camera": 7} and board.left_out == () and board.without == {}
    assert 200 < board.n_corners["camera"] <= 280
    assert 0.005 < board.sigma_px["camera"] < 0.05
    assert "is flat to" not in text and "bent" not in text


def test_the_report_shows_the_board(run_of):
    out, _ = run_of(*MONO)
    page = (out / "report.html").read_text()
    for part in ('<section id="board">', "Where corners lie", "Views of camera", "board-views-0"):
        assert part in page
    assert "scan alone, sigma" not in page  # there is none


@pytest.mark.slow
def test_the_same_images_give_the_same_numbers(run_of):
    first, _ = run_of(*MONO)
    second, text = run_of(*MONO, "--json")
    one, two = (json.loads((out / "calibration.json").read_text()) for out in (first, second))
    assert json.loads(text) == two  # and it is all of stdout
    for each in (one, two):
        del each["provenance"]["command"], each["solve"]["seconds"]
    assert one == two


# ---- a rig -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def stereo(run_of, images) -> Calibrated:
    return run_of("stereo", "--truth", str(images / "truth.json"))


def test_a_rig_is_right_within_its_sigmas_and_metric(stereo):
    out, text = stereo
    calibration = load_calibration(out / "calibration.json")
    assert set(calibration.cameras) == set(STEREO)
    for name, eye in STEREO.items():
        assert np.abs(lens_off(calibration.cameras[name], eye)).max() < 4
        assert calibration.cameras[name].sigma["fx"] < 2
    rig = calibration.rig
    assert rig.metric and rig.reference == "left"
    assert np.abs(place_off(rig.cam_from_rig["right"], RIGHT.cam_from_rig)).max() < 4
    assert max(rig.cam_from_rig["right"].sigma_translation) < 1e-3
    assert rig.scale.source == "board: a ChArUco board of 7 x 5 squares (DICT_4X4_50)"
    # the squares are known to a thousandth, and the rig a little less for the noise
    assert 1e-3 <= rig.scale.sigma_relative < 2e-3 and not rig.scale.contradicted
    assert [one.what for one in rig.scale.ledger] == ["square of the board (35 mm)"]
    rows = [row.split("│") for row in text.split("against the truth")[1].splitlines()]
    z = {row[1].strip(): float(row[-2]) for row in rows if len(row) > 6}
    assert len(z) == 2 * 5 + 6 and max(map(abs, z.values())) < 4
    assert z["left.fx"] == pytest.approx(
        lens_off(calibration.cameras["left"], STEREO["left"])[0], abs=0.1
    )
    assert f"cam_from_rig: reference left, scale {rig.scale.source}" in text


def test_views_that_do_not_fit_are_left_out_by_name(stereo):
    out, text = stereo
    calibration = load_calibration(out / "calibration.json")
    board = calibration.board
    assert board is not None and board.left_out
    assert all(line.split(": ")[0] in ("left/06", "right/06") for line in board.left_out)
    assert all("not synchronised, or the board moved" in line for line in board.left_out)
    n_left = 7 - sum(line.startswith("left/") for line in board.left_out)
    n_right = 6 - sum(line.startswith("right/") for line in board.left_out)
    assert board.n_images == {"left": n_left, "right": n_right}
    assert calibration.solve.n_images == n_left + n_right
    (said,) = (one for one in calibration.verdict.messages if "left out" in one)
    assert said.startswith("1 view of the board was left out: right/06: ")
    assert f"note: {said}" in text
    page = (out / "report.html").read_text()
    assert "Views of left" in page and "Views of right" in page
    assert board.left_out[0].split(": ")[0] in page


def test_a_bend_is_estimated_where_it_may_be(stereo):
    board = load_calibration(stereo[0] / "calibration.json").board
    assert board is not None and min(board.sigma_bend_mm) > 0
    assert np.abs(np.divide(board.bend_mm, board.sigma_bend_mm)).max() < 4
    assert max(board.sigma_bend_mm) < 0.1 and board.sigma_size == pytest.approx(1e-3, rel=0.01)


@pytest.mark.slow
def test_from_python_it_is_the_same(images, tmp_path, stereo):
    """And of squares that are said to be 2 % larger, the rig is 2 % larger, and no lens changes."""
    larger = CHARUCO.model_copy(update={"square_m": 1.02 * 0.035, "marker_m": 1.02 * 0.026})
    stages: list[str] = []
    first = load_calibration(stereo[0] / "calibration.json")
    options = TargetOptions(lens=first.cameras["left"].lens)
    outcome = calibrate_target(
        images / "stereo", larger, options, RigConfig().with_options(options), Cache(tmp_path),
        lambda stage, done, total: stages.append(stage), "by hand",
    )  # fmt: skip
    ours = outcome.calibration
    assert ours.provenance.command == "by hand"
    for name in STEREO:
        for p, value in first.cameras[name].params.items():
            off = abs(ours.cameras[name].params[p] - value)
            assert off < 0.2 * first.cameras[name].sigma[p]
    a, b = (one.rig.cam_from_rig["right"].translation for one in (first, ours))
    np.testing.assert_allclose(b, 1.02 * np.array(a), atol=2e-5)
    assert "choosing the lens" not in stages  # it is said
    order = ("reading images", "looking for the board", "solving", "covariance")
    places = [stages.index(stage) for stage in order]
    assert places == sorted(places)
