"""Boards that are not there, or not as they are described: one clear line, and nothing written."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from synthetic.targets import (
    CHARUCO,
    CHECKERBOARD,
    LEFT,
    PLACES,
    RIGHT,
    GrayImage,
    folder_of,
    views_of,
    without_board,
)

from graphs.camera import Camera
from graphs.frames import Transform
from sfm_calib.boards.load import board_yaml
from sfm_calib.boards.spec import Board, Checkerboard
from sfm_calib.cli import main
from sfm_calib.result import load_calibration, save_calibration, truth

EYE, OTHER_EYE = LEFT.smaller(0.5), RIGHT.smaller(0.5)
WALL = without_board(EYE.size)
OTHER = Checkerboard(inner_corners=(7, 4), square_m=0.035)
PROGRESS = ("reading images", "looking for the board", "solving", "covariance", "leaving out")
FRONTAL = (
    (0.50, 0.50, 0.40, (0, 0, 0)),
    (0.40, 0.45, 0.36, (2, -1, 0)),
    (0.60, 0.50, 0.42, (-1, 2, 0)),
    (0.50, 0.60, 0.38, (1, 1, 0)),
    (0.45, 0.40, 0.40, (-1, -1, 0)),
)
Images = Callable[[str], list[GrayImage]]


@pytest.fixture(scope="module")
def images() -> Images:
    """Five views of a board; each kind is rendered once."""
    seen: dict[str, list[GrayImage]] = {}
    kinds: dict[str, tuple[Board, object, Sequence[tuple]]] = {
        "checkerboard": (CHECKERBOARD, EYE, PLACES[:5]),
        "other": (OTHER, EYE, PLACES[:4]),
        "charuco": (CHARUCO, EYE, PLACES[:3]),
        "of right": (CHARUCO, OTHER_EYE, PLACES[:3]),
        "frontal": (CHECKERBOARD, EYE, FRONTAL),
    }

    def of(kind: str) -> list[GrayImage]:
        if kind not in seen:
            seen[kind] = views_of(*kinds[kind])  # type: ignore[arg-type]
        return seen[kind]

    return of


def target(tmp_path: Path, board: Board, cameras: dict[str, list], *more: str) -> list[str]:
    folder_of(tmp_path / "images", cameras)
    (tmp_path / "board.yaml").write_text(board_yaml(board))
    return command(tmp_path, *more)


def command(tmp_path: Path, *more: str) -> list[str]:
    given = [str(tmp_path / "images"), "--board", str(tmp_path / "board.yaml")]
    return ["target", *given, "-o", str(tmp_path / "new" / "out"), *more]


def refusal(arguments: list[str], capfd: pytest.CaptureFixture[str], out: Path) -> str:
    """The one line that a refused command says; OUT is as it was: not there."""
    assert main(arguments) == 2
    printed = capfd.readouterr()  # of the process: decoders write past sys.stderr
    lines = [line for line in printed.err.splitlines() if not line.startswith(PROGRESS)]
    assert printed.out == "" and len(lines) == 1, printed.err
    assert lines[0].startswith("sfm-calib: ") and not out.parent.exists()
    return lines[0].removeprefix("sfm-calib: ")


@pytest.fixture
def refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> Callable[[list[str]], str]:
    return lambda arguments: refusal(arguments, capfd, tmp_path / "new" / "out")


# ---- images that do not show it ------------------------------------------------------------


def test_no_board_at_all(tmp_path, refused):
    said = refused(target(tmp_path, CHECKERBOARD, {"": [WALL] * 3}))
    assert "8 x 5 inner corners in 3 images and found none" in said
    assert "show all of it, sharp" in said


def test_a_board_of_another_size_is_told_by_its_size(tmp_path, refused, images):
    said = refused(target(tmp_path, CHECKERBOARD, {"": images("other")}))
    assert "8 x 5 inner corners in 4 images and found none" in said
    assert "7 x 4 inner corners fits 4 of 4" in said and "inner_corners: [7, 4]" in said


def test_mirrored_images(tmp_path, refused, images):
    mirrored = [np.ascontiguousarray(image[:, ::-1]) for image in images("charuco")]
    said = refused(target(tmp_path, CHARUCO, {"": mirrored}))
    assert "in 3 images and found none: 3 of 3" in said
    assert "mirrored; un-mirror the images, or write 'two_sided: true'" in said


def test_images_of_two_sizes(tmp_path, refused, images):
    cameras = {"cam0": [*images("checkerboard"), without_board(LEFT.size)]}
    said = refused(target(tmp_path, CHECKERBOARD, cameras))
    assert "camera cam0 has images of 2 sizes (5 of 320x240, 1 of 640x480)" in said
    assert "remove the odd images or give them a folder of their own" in said


def test_a_camera_with_too_few_views(tmp_path, refused, images):
    cameras = {"left": images("charuco"), "right": [*images("of right")[:2], WALL]}
    said = refused(target(tmp_path, CHARUCO, cameras))
    assert said.startswith("right shows a ChArUco board of 7 x 5 squares")
    assert "in 2 of 3 images (needs 3): take more, with the board tilted" in said


def test_a_camera_that_never_sees_it(tmp_path, refused, images):
    cameras = {"left": images("charuco"), "right": [WALL] * 3}
    said = refused(target(tmp_path, CHARUCO, cameras))
    assert "in 3 images of camera right (found in 3 of camera left) and found none" in said


def test_cameras_that_never_see_it_together(tmp_path, refused, images):
    nothing = [None] * 3
    cameras = {"left": images("charuco") + nothing, "right": nothing + images("of right")}
    said = refused(target(tmp_path, CHARUCO, cameras))
    assert "right never sees the board together with left: 3 frames against 3" in said
    assert "show the board to both at once" in said


def test_too_few_images(tmp_path, refused, images):
    said = refused(target(tmp_path, CHECKERBOARD, {"": images("checkerboard")[:1]}))
    assert "holds 1 usable image; a calibration needs at least 3: take more" in said


def test_no_folder(tmp_path, refused):
    (tmp_path / "board.yaml").write_text(board_yaml(CHECKERBOARD))
    assert "no such folder" in refused(command(tmp_path))


def test_a_truth_of_other_cameras(tmp_path, refused):
    lens = Camera("top", "pinhole", EYE.size, np.array([280.0, 280.0, 160.0, 120.0]))
    save_calibration(truth([lens], [Transform.identity()], ""), tmp_path / "truth.json")
    arguments = target(tmp_path, CHECKERBOARD, {"": [WALL] * 3})
    said = refused([*arguments, "--truth", str(tmp_path / "truth.json")])
    assert "the truth is of 1 cameras (top)" in said and "looked for" not in said


# ---- images that show it badly -------------------------------------------------------------


@pytest.mark.slow
def test_two_boards_in_one_folder_are_told(tmp_path, images):
    cameras = {"": [*images("checkerboard"), *images("other")]}
    assert main(target(tmp_path, CHECKERBOARD, cameras, "--lens", "radial", "--json")) == 0
    calibration = load_calibration(tmp_path / "new" / "out" / "calibration.json")
    assert calibration.solve.n_images == 5
    (said,) = (one for one in calibration.verdict.messages if "two boards" in one)
    assert said.startswith("4 of 9 images do not show the board; a checkerboard of 7 x 4")
    assert "leave out the images of one" in said


@pytest.mark.slow
def test_a_board_that_is_never_tilted_leaves_the_focal_length_weak(tmp_path, images, capsys):
    arguments = target(tmp_path, CHECKERBOARD, {"cam0": images("frontal")}, "--lens", "radial")
    assert main(arguments) == 0
    verdict = load_calibration(tmp_path / "new" / "out" / "calibration.json").verdict
    assert not verdict.usable
    (focal,) = (one for one in verdict.weak if one.kind.startswith("focal length"))
    assert {"cam0.fx", "cam0.fy"} <= set(focal.parameters) and focal.what.startswith("fx, fy")
    assert focal.remedy == "tilt the board by 30 to 45 deg, to all sides, near and far"
    messages = "; ".join(verdict.messages)
    for part in (
        "near-frontal views: the board faces the cameras within",
        "the views hardly tell cam0's focal length",
        "not usable: the sigma of cam0.fx is",
    ):
        assert part in messages
    printed = capsys.readouterr().out
    assert "NOT USABLE" in printed and f"weak: {focal.what}" in printed


# ---- boards that are described badly -------------------------------------------------------

CHECKER = "type: checkerboard\n"
BOARDS = {
    "empty": ("", "describes no board: write 'type: checkerboard', 'inner_corners: [8, 6]'"),
    "a list": ("[1, 2]", "describes no board"),
    "no type": ("square_m: 0.02", "no type: write 'type: checkerboard' or another of"),
    "a wrong type": ("type: checkerbord", "did you mean 'checkerboard'?"),
    "no size": (CHECKER, "inner_corners: is missing, and a board of type checkerboard needs it"),
    "an unknown key": (f"{CHECKER}inner_corner: [8, 6]", "did you mean 'inner_corners'?"),
    "one number": (f"{CHECKER}inner_corners: 8\nsquare_m: 0.02", "takes a list, like [8, 6]"),
    "negative": (f"{CHECKER}inner_corners: [8, 6]\nsquare_m: -1", "-1 m is no length; give metres"),
    "in micrometres": (f"{CHECKER}inner_corners: [8, 6]\nsquare_m: 25000", "(got 25000)"),
    "no YAML": ("type: {", "board.yaml is not valid YAML in line 1"),
    "Kalibr's": ("target_type: checkerboard\ntargetCols: 8", "targetRows: is missing"),
}


@pytest.mark.parametrize(("text", "message"), BOARDS.values(), ids=BOARDS)
@pytest.mark.parametrize("name", ["target", "calibrate"])
def test_a_bad_board(tmp_path, refused, name, text, message):
    folder_of(tmp_path / "images", {"": [WALL] * 3})
    (tmp_path / "board.yaml").write_text(text)
    arguments = command(tmp_path)
    said = refused([name, *arguments[1:]])
    assert str(tmp_path / "board.yaml") in said and message in said


def test_no_board_file(tmp_path, refused):
    folder_of(tmp_path / "images", {"": [WALL] * 3})
    said = refused(command(tmp_path))
    assert f"no such board: {tmp_path / 'board.yaml'}; give a YAML file" in said


def test_target_needs_a_board(tmp_path, capsys):
    with pytest.raises(SystemExit) as caught:
        main(["target", str(tmp_path), "-o", str(tmp_path / "out")])
    assert caught.value.code == 2 and "--board YAML" in capsys.readouterr().err


# ---- a board beside a scan -----------------------------------------------------------------


def beside_a_scan(tmp_path: Path, cameras: dict[str, list] | None) -> list[str]:
    """`calibrate --board` of a scan by `left` and `right` that no mapping would place."""
    folder_of(tmp_path / "scan", {"left": [WALL] * 3, "right": [WALL] * 3})
    (tmp_path / "board.yaml").write_text(board_yaml(CHARUCO))
    given = ["--board", str(tmp_path / "board.yaml")]
    if cameras is not None:
        folder_of(tmp_path / "boards", cameras)
        given += ["--board-images", str(tmp_path / "boards")]
    out = str(tmp_path / "new" / "out")
    return ["calibrate", str(tmp_path / "scan"), "-o", out, *given]


def test_board_images_need_a_board(tmp_path, refused):
    arguments = beside_a_scan(tmp_path, {"left": [WALL] * 3})
    del arguments[4:6]
    said = refused(arguments)
    assert said == "--board-images needs --board YAML: say what board they show"


def test_board_images_of_another_camera(tmp_path, refused, images):
    said = refused(beside_a_scan(tmp_path, {"left": images("charuco"), "rihgt": [WALL] * 3}))
    assert "--board-images has a camera 'rihgt' that the scan has not; did you mean 'right'" in said


def test_board_images_of_another_size(tmp_path, refused):
    said = refused(beside_a_scan(tmp_path, {"right": [without_board(LEFT.size)] * 3}))
    assert "camera right: its images of the board are 640x480 and its scan is 320x240" in said
    assert "take both with the same settings" in said


@pytest.mark.parametrize("apart", [False, True], ids=["in the scan", "in other images"])
def test_a_board_that_is_nowhere(tmp_path, refused, apart):
    """Said before the scan is mapped, of which nothing is kept."""
    said = refused(beside_a_scan(tmp_path, {"left": [WALL] * 3} if apart else None))
    n_images = 3 if apart else 6
    assert f"looked for a ChArUco board of 7 x 5 squares (DICT_4X4_50) in {n_images}" in said


# ---- a board to print ----------------------------------------------------------------------

SIZE = ["--type", "checkerboard", "--inner-corners", "8", "6"]
PRINTS = {
    "no type": ([], "no type: write 'type: checkerboard'"),
    "no size": (SIZE, "square_m: is missing, and a board of type checkerboard needs it"),
    "negative": ([*SIZE, "--square-m", "-0.02"], "square_m: -0.02 m is no length; give metres"),
    "one row": ([*SIZE[:-1], "1", "--square-m", "0.02"], "inner_corners.1: Input should be"),
    "too large": (
        [*SIZE, "--square-m", "0.1", "--page", "a4"],
        "900 x 700 mm and does not fit a4 (210 x 297 mm) with its margin and rulers: take a larger "
        "page, or a square_m of 0.0",
    ),
    "of another type": (["--type", "charuco", *SIZE[2:]], "unknown key 'inner_corners'"),
}


@pytest.mark.parametrize(("flags", "message"), PRINTS.values(), ids=PRINTS)
def test_a_board_that_cannot_be_printed(tmp_path, refused, flags, message):
    assert message in refused(["board", "-o", str(tmp_path / "new" / "out" / "b.pdf"), *flags])


def test_a_page_is_written_as_pdf(tmp_path, refused):
    page = tmp_path / "new" / "out" / "b.png"
    assert "call it b.pdf" in refused(["board", "-o", str(page), *SIZE, "--square-m", "0.02"])


@pytest.mark.parametrize("there", ["b.pdf", "b.yaml"])
def test_printed_boards_are_not_overwritten(tmp_path, capsys, there):
    page = tmp_path / "b.pdf"
    (tmp_path / there).write_text("mine")
    arguments = ["board", "-o", str(page), *SIZE, "--square-m", "0.02"]
    assert main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == (
        f"sfm-calib: {tmp_path / there} is there already: choose another name, or --overwrite"
    )
    assert [path.name for path in tmp_path.iterdir()] == [there]
    assert (tmp_path / there).read_text() == "mine"
    assert main([*arguments, "--overwrite"]) == 0
    assert page.read_bytes().startswith(b"%PDF") and "square_m" in (tmp_path / "b.yaml").read_text()
