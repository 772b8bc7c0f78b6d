"""Measured distances from rig.yaml to the result: baselines, frames, clicks; what is refused."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
import yaml
from synthetic.scans import QUICK, simulation

from graphs.camera import project
from graphs.frames import FloatArray, Transform
from graphs.noise import with_click_sigma
from graphs.problem import Estimate, KnownSpan, Problem
from graphs.refine import noise_of
from graphs.scale import length_of
from sfm_calib.calibrate import covariance_of, solve_problem
from sfm_calib.cli import main
from sfm_calib.config import RigConfig
from sfm_calib.errors import CalibrationError
from sfm_calib.images import Scan, ScanImage
from sfm_calib.mapping import Mapped
from sfm_calib.nominal import check_config, start_from_config
from sfm_calib.result import Calibration, load_calibration
from sfm_calib.run import Run
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks
from sfm_calib.summary import summarise

TRACKS = TrackOptions(
    rig="stereo", frames=12, points=900, max_points_per_image=60, baseline_sigma_m=0.0,
    outlier_share=0.02,
)  # fmt: skip
CLICK_SIGMA_PX = 1.0
MARKS = np.array([[0.9, 2.2, 0.9], [-0.6, 2.3, 1.2]])  # on a wall of the room


def scan_of(problem: Problem) -> Scan:
    cameras = problem.initial.cameras
    names, sizes = tuple(c.name for c in cameras), tuple(c.size for c in cameras)
    return Scan(Path(), names, sizes, problem.frame_names, ())


def clicks_on(
    true: Estimate, problem: Problem, mark: FloatArray, rng: np.random.Generator, count: int = 6
) -> list[dict[str, object]]:
    """A mark as a person would click it, in images spread over the scan."""
    found: list[dict[str, object]] = []
    for frame, name in enumerate(problem.frame_names):
        for camera, cam_from_rig in zip(true.cameras, true.cam_from_rig, strict=True):
            pixel = project(camera, cam_from_rig @ (true.rig_from_world[frame] @ mark))
            if (pixel > 20).all() and (pixel < np.array(camera.size) - 20).all():
                clicked = (pixel + CLICK_SIGMA_PX * rng.standard_normal(2)).tolist()
                found.append({"camera": camera.name, "frame": name, "pixel": clicked})
    assert len(found) >= count
    return [found[i] for i in np.linspace(0, len(found) - 1, count).astype(int)]


def said_of(
    kind: str, true: Estimate, problem: Problem, rng: np.random.Generator
) -> dict[str, object]:
    """`scale` of a rig.yaml, the tape's error in it."""
    said: dict[str, object] = {}
    if kind == "baseline":
        ends = [t.inverse.translation for t in true.cam_from_rig]
        said = {"cameras": ["cam0", "cam1"]}
    elif kind == "frames":
        ends = [true.rig_from_world[f].inverse.translation for f in (0, 6)]
        said = {"between": [problem.frame_names[f] for f in (0, 6)]}
    else:
        ends = list(MARKS)
        said = {"between": [clicks_on(true, problem, mark, rng) for mark in MARKS]}
    length_m = float(np.linalg.norm(ends[1] - ends[0]))
    sigma_m = 0.003 * length_m
    return {kind: said | {"length_m": length_m + sigma_m * rng.normal(), "sigma_m": sigma_m}}


def calibrated(problem: Problem, scale: dict[str, object]) -> Calibration:
    """What `calibrate` makes of a problem that mapping left."""
    config = RigConfig.model_validate({"scale": scale, "lens": "radial"})
    refinement = solve_problem(start_from_config(problem, config), config, lambda *progress: None)
    mapped = Mapped(problem, (), {})
    covariance, split = covariance_of(refinement, config, lambda *progress: None)
    run = Run(scan_of(problem), config, mapped, refinement, covariance, {}, "", split=split)
    return summarise(run)[0]


@pytest.fixture(scope="module")
def mapped() -> tuple[Problem, Estimate]:
    """As mapping leaves it: of any size."""
    problem, true = simulate_tracks(TRACKS, np.random.default_rng(0))
    return replace(problem, initial=problem.initial.scaled(7.3)), true


WORDS = {
    "baseline": "baseline cam0 to cam1: ",
    "frames": "distance from frame 000000 to frame 000006: ",
    "points": "distance between two clicked marks: ",
}


@pytest.mark.parametrize("kind", WORDS)
def test_a_measured_distance_makes_the_result_metric(
    mapped: tuple[Problem, Estimate], kind: str
) -> None:
    problem, true = mapped
    scale = said_of(kind, true, problem, np.random.default_rng(5))
    result = calibrated(problem, scale)
    assert result.rig.metric and result.rig.scale.source.startswith(WORDS[kind])
    assert result.solve is not None and result.solve.converged
    assert result.verdict is not None and not any("click" in m for m in result.verdict.messages)
    entry = result.rig.cam_from_rig["cam1"]
    wrong = entry.translation - true.cam_from_rig[1].translation
    assert (np.abs(wrong) < 4 * np.array(entry.sigma_translation)).all()
    length = np.linalg.norm(true.cam_from_rig[1].translation)
    assert np.linalg.norm(entry.sigma_translation) < 0.1 * length
    assert result.rig.scale.sigma_relative is not None
    if kind == "points":
        assert 0.0031 < result.rig.scale.sigma_relative < 0.02
    else:
        assert result.rig.scale.sigma_relative == pytest.approx(0.003, rel=0.02)


def all_of(true: Estimate, problem: Problem) -> dict[str, object]:
    """A `scale` with a source of every kind, of paths two."""
    rng = np.random.default_rng(5)
    said: dict[str, object] = {}
    for kind in WORDS:
        said |= said_of(kind, true, problem, rng)
    ends = [true.rig_from_world[f].inverse.translation for f in (2, 9)]
    length_m = float(np.linalg.norm(ends[1] - ends[0]))
    names = [problem.frame_names[f] for f in (2, 9)]
    second = {"between": names, "length_m": length_m, "sigma_m": 0.003 * length_m}
    return said | {"frames": [said["frames"], second]}


def test_measured_distances_of_every_kind_test_each_other(
    mapped: tuple[Problem, Estimate],
) -> None:
    problem, true = mapped
    scale = all_of(true, problem)
    result = calibrated(problem, scale)
    ledger = result.rig.scale.ledger
    words = ["baseline cam0 to cam1", "distance from frame 000000 to frame 000006"]
    words += ["distance from frame 000002 to frame 000009", "distance between two clicked marks"]
    assert [entry.what for entry in ledger] == words
    assert all(entry.z is not None and abs(entry.z) < 3 for entry in ledger)
    assert not result.rig.scale.contradicted and result.rig.scale.source.endswith(", and 3 more")
    alone = min(entry.sigma_m / entry.measured_m for entry in ledger)
    assert 0.4 * alone < (result.rig.scale.sigma_relative or 0.0) < 0.7 * alone
    scale["baseline"]["length_m"] *= 1.05
    wrong = calibrated(problem, scale)
    assert wrong.rig.scale.contradicted and wrong.verdict is not None and wrong.verdict.usable
    assert [entry.suspect for entry in wrong.rig.scale.ledger] == [True, False, False, False]
    (told,) = [message for message in wrong.verdict.messages if "contradicts" in message]
    assert told == wrong.verdict.messages[0] and told.startswith("the baseline cam0 to cam1 of ")


def test_the_best_distance_gives_the_size_to_start_from(mapped: tuple[Problem, Estimate]) -> None:
    problem, true = mapped
    scale = all_of(true, problem)
    scale["frames"][1]["sigma_m"] /= 10
    started = start_of(problem, scale)
    assert len(started.scales) == 4
    best = started.scales[2]
    assert length_of(best, started.initial) == pytest.approx(best.length_m)


# ---- clicks become tracks -------------------------------------------------------------------

Scale = dict[str, dict[str, object]]


@pytest.fixture
def points(mapped: tuple[Problem, Estimate]) -> Scale:
    """`scale` with six clicks on each of two marks, to be spoilt."""
    problem, true = mapped
    return copy.deepcopy(said_of("points", true, problem, np.random.default_rng(5)))


def start_of(problem: Problem, scale: Scale) -> Problem:
    return start_from_config(problem, RigConfig.model_validate({"scale": scale, "lens": "radial"}))


def test_clicks_are_two_tracks_more_in_metres(
    mapped: tuple[Problem, Estimate], points: Scale
) -> None:
    problem, _ = mapped
    started = start_of(problem, points)
    n, (source,) = len(problem.initial.points), started.scales
    assert isinstance(source, KnownSpan) and source.points == (n, n + 1)
    assert source.click_sigma_px == 1.0
    assert length_of(source, started.initial) == pytest.approx(source.length_m)
    before, seen = problem.observations, started.observations
    np.testing.assert_array_equal(seen.pixels[: len(before)], before.pixels)
    clicks = [click for mark in points["points"]["between"] for click in mark]
    assert len(seen) == len(before) + len(clicks) == len(before) + 12
    for row, click in enumerate(clicks, len(before)):
        assert started.initial.cameras[seen.camera[row]].name == click["camera"]
        assert started.frame_names[seen.frame[row]] == click["frame"]
        np.testing.assert_array_equal(seen.pixels[row], click["pixel"])
    again = with_click_sigma(started, noise_of(started))
    np.testing.assert_array_equal(again.observations.relative_sigma, seen.relative_sigma)


def test_marks_start_where_their_rays_meet() -> None:
    """Exact clicks in an exact scan: at the very place, however near some of the cameras are."""
    exact = TRACKS.model_copy(update={"sigma_px": 0.0, "outlier_share": 0.0})
    problem, true = simulate_tracks(exact, np.random.default_rng(0))
    problem = replace(problem, initial=true)
    between = [clicks_on(true, problem, mark, np.random.default_rng(0)) for mark in MARKS]
    for clicks in between:
        for click in clicks:
            camera, frame = int(click["camera"][-1]), problem.frame_names.index(click["frame"])
            in_camera = true.cam_from_rig[camera] @ (
                true.rig_from_world[frame] @ MARKS[between.index(clicks)]
            )
            click["pixel"] = project(true.cameras[camera], in_camera).tolist()
    length_m = float(np.linalg.norm(MARKS[1] - MARKS[0]))
    said = {"points": {"between": between, "length_m": length_m, "sigma_m": 0.01}}
    started = start_of(problem, said)
    np.testing.assert_allclose(started.initial.points[-2:], MARKS, atol=1e-9)


def test_one_wrong_click_of_many_is_set_aside_and_told(
    mapped: tuple[Problem, Estimate], points: Scale
) -> None:
    problem, true = mapped
    points["points"]["between"][0][2]["pixel"][0] += 15.0
    result = calibrated(problem, points)
    assert result.verdict is not None
    told = [message for message in result.verdict.messages if "clicks" in message]
    assert told == [
        "1 of 12 clicks on the marks of scale.points contradict the others and were set aside: "
        "look at them again"
    ]
    entry = result.rig.cam_from_rig["cam1"]
    wrong = entry.translation - true.cam_from_rig[1].translation
    assert (np.abs(wrong) < 4 * np.array(entry.sigma_translation)).all()


def test_one_wrong_click_of_three_is_refused(
    mapped: tuple[Problem, Estimate], points: Scale
) -> None:
    mark = points["points"]["between"][0]
    del mark[1:4]
    mark[1]["pixel"][1] += 15.0
    with pytest.raises(CalibrationError, match=r"lies \d+\.\d px \(\d+ sigmas\) in cam"):
        calibrated(mapped[0], points)


def test_clicks_on_different_things_are_refused(
    mapped: tuple[Problem, Estimate], points: Scale
) -> None:
    problem, true = mapped
    fine = replace(problem, initial=true.scaled(7.3))  # mapping is rarely off by ten pixels
    marks = points["points"]["between"]
    marks[1][3]["pixel"][0] += 60.0
    image = f"{marks[1][3]['camera']}/{marks[1][3]['frame']}"
    message = (
        rf"clicks on the second mark do not meet: in {image}, the place where they come closest is "
        r"\d+ px off \(up to 1[1-3] px pass with click_sigma_px = 1\); click"
    )
    with pytest.raises(CalibrationError, match=message):
        start_of(fine, points)


def test_clicks_from_one_place_are_refused(mapped: tuple[Problem, Estimate], points: Scale) -> None:
    config = RigConfig.model_validate({"scale": points, "lens": "radial", "min_parallax_deg": 89.0})
    with pytest.raises(CalibrationError, match=r"under \d+ deg of parallax \(needs 89\): click"):
        start_from_config(mapped[0], config)


def test_ends_that_mapping_lost_are_refused(
    mapped: tuple[Problem, Estimate], points: Scale
) -> None:
    problem, _ = mapped
    click = points["points"]["between"][0][0]
    f, c = problem.frame_names.index(click["frame"]), int(click["camera"][-1])
    seen = problem.observations
    without = seen.subset((seen.frame != f) | (seen.camera != c))
    message = f"the image {click['camera']}/{click['frame']} could not be placed on the rig"
    with pytest.raises(CalibrationError, match=message):
        start_of(replace(problem, observations=without), points)
    shorter = replace(
        problem,
        initial=replace(problem.initial, rig_from_world=problem.initial.rig_from_world[:11]),
        observations=seen.subset(seen.frame < 11),
        frame_names=problem.frame_names[:11],
    )
    path = {"frames": {"between": ["000000", "000011"], "length_m": 1.0, "sigma_m": 0.1}}
    message = r"frame 000011 could not be placed; .* did you mean '00001\d'\? it has 000000, 000001"
    with pytest.raises(CalibrationError, match=message):
        start_of(shorter, path)


def test_ends_at_one_place_are_refused(mapped: tuple[Problem, Estimate]) -> None:
    problem, _ = mapped
    poses = problem.initial.rig_from_world
    same = replace(problem, initial=replace(problem.initial, rig_from_world=(poses[0],) * 12))
    path = {"frames": {"between": ["000000", "000003"], "length_m": 1.0, "sigma_m": 0.1}}
    with pytest.raises(CalibrationError, match="both ends of the distance from frame 000000 to"):
        start_of(same, path)


# ---- what check_config says of the scan -----------------------------------------------------

TWO = {"a": ("1", "2", "3"), "b": ("1", "2")}
CLICKS = [{"camera": "a", "frame": f, "pixel": [10.0 * i, 5.0]} for i, f in enumerate("123")]
OTHERS = [{"camera": "a", "frame": f, "pixel": [10.0 * i, 50.0]} for i, f in enumerate("123")]


def change(**of_click: object) -> list[dict[str, object]]:
    return [*OTHERS[:2], OTHERS[2] | of_click]


UNKNOWN = {
    "camera": (change(camera="c"), "the scan has no camera 'c'; it has a, b"),
    "frame": (change(frame="4"), "the scan has no frame '4'; it has 1, 2, 3"),
    "image": (change(camera="b"), "b has no image in frame 3; click the second mark in another"),
    "twice in an image": (change(frame="2"), "the second mark is clicked twice in a/2"),
    "left of the image": (change(pixel=[-0.6, 5]), r"the click (-0.6, 5) lies outside a/3"),
    "below the image": (change(pixel=[5, 239.6]), "a/3, which has 320 x 240 px; count pixels"),
    "the same mark": (change(pixel=[20, 5]), "both marks are clicked at (20, 5) in a/3; click"),
}


def checked(scale: Scale) -> None:
    images = [
        ScanImage(camera, int(frame) - 1, f"{name}/{frame}.png")
        for camera, (name, frames) in enumerate(TWO.items())
        for frame in frames
    ]
    scan = Scan(Path(), tuple(TWO), ((320, 240),) * 2, ("1", "2", "3"), tuple(images))
    check_config(RigConfig.model_validate({"scale": scale}), scan)


@pytest.mark.parametrize(("second", "message"), UNKNOWN.values(), ids=UNKNOWN)
def test_clicks_that_the_scan_does_not_have(second: list[dict[str, object]], message: str) -> None:
    said = {"length_m": 1.0, "sigma_m": 0.1}
    checked({"points": {"between": [CLICKS, OTHERS], **said}})
    with pytest.raises(CalibrationError) as caught:
        checked({"points": {"between": [CLICKS, second], **said}})
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_a_click_counts_for_one_distance() -> None:
    said = {"between": [CLICKS, OTHERS], "length_m": 1.0, "sigma_m": 0.1}
    moved = [click | {"pixel": [5.0 + i, 90.0]} for i, click in enumerate(OTHERS)]
    more = [click | {"pixel": [5.0 + i, 99.0]} for i, click in enumerate(OTHERS)]
    checked({"points": [said, said | {"between": [moved, more]}]})
    message = r"scale.points.1.between: the click \(0, 50\) in a/1 is one of scale.points.0 already"
    with pytest.raises(CalibrationError, match=message):
        checked({"points": [said, said | {"between": [moved, OTHERS]}]})


def test_clicks_may_lie_on_the_outermost_pixels() -> None:
    edges = [change(pixel=[-0.5, 239.5]), change(pixel=[319.5, -0.5])]
    for second in edges:
        checked({"points": {"between": [CLICKS, second], "length_m": 1.0, "sigma_m": 0.1}})


# ---- a scan of images -----------------------------------------------------------------------


@pytest.mark.slow
def test_a_path_between_frames_makes_a_scan_metric(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The rendered rig's baseline, known through nothing but how far the rig moved."""
    copytree(simulation() / "scan", tmp_path / "scan")
    frames = json.loads((simulation() / "truth_frames.json").read_text())
    both = frames["000000"], frames["000005"]
    ends = [Transform.from_wxyz(*t.values()).inverse.translation for t in both]
    said = {"length_m": float(np.linalg.norm(ends[1] - ends[0])), "sigma_m": 0.001}
    arguments = ["calibrate", str(tmp_path / "scan"), "-o", str(tmp_path / "out"), *QUICK]

    def run(first: str) -> int:
        scale = {"frames": {"between": [first, "000005"], **said}}
        (tmp_path / "scan" / "rig.yaml").write_text(yaml.safe_dump({"scale": scale}))
        return main(arguments)

    assert run("00002") == 2
    assert capsys.readouterr().err.splitlines()[-1] == (
        "sfm-calib: scale.frames.between: the scan has no frame '00002'; did you mean '000002'? "
        "it has 000000, 000001, 000002, 000003, 000004, 000005, 000006, 000007"
    )
    assert run("000000") == 0
    result = load_calibration(tmp_path / "out" / "calibration.json")
    assert result.rig.metric and "frame 000000 to frame 000005" in result.rig.scale.source
    truth = load_calibration(simulation() / "truth.json")
    found, true = (np.array(r.rig.cam_from_rig["cam1"].translation) for r in (result, truth))
    sigma = np.array(result.rig.cam_from_rig["cam1"].sigma_translation)
    assert (np.abs(found - true) < 5 * sigma).all()
    assert np.linalg.norm(sigma) < 0.2 * np.linalg.norm(true)
