"""Calibrations as trials: options from one definition, rows with sigmas, answers of fleets."""

from __future__ import annotations

import json
import pickle
import re
import shlex
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
import yaml
from pydantic import ValidationError
from synthetic.scans import blank

from experiments.calibration_options import CHANGED, CalibrationOptions, CalibrationTrial, Changed
from experiments.calibration_rows import row_of, truth_columns
from experiments.calibration_sources import source_of, stretch_of, touched
from experiments.calibrations import CACHE, STUDY, line_of, trial
from experiments.runner.protocol import Cell
from experiments.runner.sweep import load_study, trials_of
from graphs.frames import log_rotation
from sfm_calib.cache import Cache
from sfm_calib.cli import config_of
from sfm_calib.config import Options, TargetOptions, first_problem
from sfm_calib.drift import DriftOptions
from sfm_calib.errors import CalibrationError
from sfm_calib.formats import read_calibration
from sfm_calib.formats.ours import rig_of
from sfm_calib.recalibrate import RecalibrateOptions
from sfm_calib.result import load_calibration, save_calibration
from sfm_calib.simulate.rigs import make_rig

ROOT = Path(__file__).parents[1]
TRACKS = {
    "simulate": "tracks", "simulate.rig": "stereo", "simulate.points": 300, "simulate.frames": 10,
    "simulate.max_points_per_image": 40, "report": False,
}  # fmt: skip


def options(**given: object) -> CalibrationOptions:
    return CalibrationTrial.model_validate(given)


def refusal(given: Mapping[str, object]) -> str:
    with pytest.raises(ValidationError) as refused:
        CalibrationTrial.model_validate(given)
    return first_problem(refused.value, model=CalibrationTrial)


# ---- options -------------------------------------------------------------------------------


@pytest.mark.parametrize("model", [Options, TargetOptions, RecalibrateOptions, DriftOptions])
def test_every_option_of_a_command_is_one_of_a_trial(model: type) -> None:
    names = set(getattr(model, "model_fields", None) or model.__dataclass_fields__)
    assert names - {"seed"} <= set(CalibrationTrial.model_fields)  # the seed is the trial's


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({}, "say what to calibrate from"),
        ({"scan": "a", "simulate": "tracks"}, "say what to calibrate from"),
        ({"scan": "a", "max_feature": 300}, "did you mean 'max_features'"),
        ({"scan": "a", "max_features": 3}, "max_features: .* greater than or equal to 100"),
        ({"scan": "a", "certify": 3}, "3 twins show too little"),
        ({"scan": "a", "loss": "hubber"}, "'huber', 'cauchy'"),
        ({"scan": "a", "frames": "time"}, "frames: Input should be 'stem' or 'order'"),
        ({"scan": "a", "prior": "full"}, "prior is for recalibrate, and the command is calibrate"),
        ({"scan": "a", "command": "recalibrate"}, "recalibrate needs old"),
        ({"scan": "a", "old": "b"}, "old is for recalibrate"),
        ({"scan": "a", "command": "target"}, "target needs board"),
        ({"scan": "a", "board_images": "b"}, "board_images needs board"),
        ({"scan": "a", "command": "recalibrate", "old": "b", "alpha": 0.7}, "0.7: it must be"),
        ({"scan": "a", "simulate.frames": 9}, "does not say simulate"),
        ({"simulate": "tracks", "simulate.frmes": 9}, "did you mean 'simulate.frames'"),
        ({"simulate": "tracks", "simulate.frames": 0}, "frames is 0: give 1 or more"),
        ({"simulate": "tracks", "simulate.noise": 1}, "which simulates tracks"),
        ({"simulate": "images", "simulate.noise": 99}, "noise is 99.0 grey levels"),
        ({"simulate": "tracks", "stretch": 5}, "stretch is for a scan"),
        ({"simulate": "tracks", "changed.camera": "cam0"}, "say simulate, and command"),
        (
            {"simulate": "tracks", "command": "recalibrate", "changed.turn_deg": 1},
            "changed.camera: Field required",
        ),
    ],
)
def test_bad_options_are_refused_with_a_remedy(given: dict[str, object], says: str) -> None:
    assert re.search(says, refusal(given)), refusal(given)


def test_options_travel_to_workers_as_they_are() -> None:
    one = options(scan="scan", lens="brown", **{"max_features": 500})
    assert one.scan is not None and one.scan == Path.cwd() / "scan"
    assert pickle.loads(pickle.dumps(one)) == one
    assert CalibrationTrial.model_validate_json(one.model_dump_json()) == one


def test_what_is_left_out_is_told_from_what_is_said() -> None:
    """`lens: auto` goes before a rig.yaml that says radtan; no lens does not."""
    silent, said = options(scan="a"), options(scan="a", lens="auto")
    assert silent.said == {} and said.given(Options) == {"lens": "auto"}
    assert silent.model_dump(mode="json") != said.model_dump(mode="json")


# ---- sources -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("study") / "scan"
    for camera in ("left", "right"):
        for frame in range(9):
            blank(place / camera / f"{frame}.png", (64, 64))
    (place / "rig.yaml").write_text("lens: radtan\nmax_features: 700\nseed: 4\n")
    return place


def test_a_stretch_is_consecutive_and_drawn_by_the_seed(scan: Path, tmp_path: Path) -> None:
    firsts = set()
    for seed in range(12):
        place = stretch_of(scan, 4, "stem", seed, tmp_path / "part")
        left = sorted(int(path.stem) for path in (place / "left").iterdir())
        assert left == list(range(left[0], left[0] + 4))
        assert sorted(int(path.stem) for path in (place / "right").iterdir()) == left
        assert (place / "left" / f"{left[0]}.png").read_bytes()
        assert (place / "rig.yaml").read_text().startswith("lens: radtan")
        firsts.add(left[0])
    assert len(firsts) > 2
    with pytest.raises(CalibrationError, match="has 9 frames"):
        stretch_of(scan, 10, "stem", 0, tmp_path / "part")


def test_options_go_before_rig_yaml_and_rig_yaml_before_defaults(
    scan: Path, tmp_path: Path
) -> None:
    """As the command line that a trial tells does it."""
    one = options(scan=scan, max_features=300, loss="huber", stretch=5)
    source = source_of(one, 3, tmp_path, Cache(tmp_path / "cache", shared=True))
    line = shlex.split(line_of(one, source, 3, tmp_path / "out"))
    assert line[:3] == ["sfm-calib", "calibrate", str(tmp_path / "scan")]
    config = config_of(Path(line[2]), line[1:])
    assert (config.lens, config.max_features, config.loss) == ("radtan", 300, "huber")
    assert config.seed == 4 + 3  # the trial's on top


def test_a_rig_is_touched_about_the_camera_itself() -> None:
    rig = make_rig("triple")
    for index in range(3):
        now = touched(rig, Changed(camera=f"cam{index}", turn_deg=2.0, focal_percent=1.0))
        assert now.cameras[index].params[0] == pytest.approx(1.01 * rig.cameras[index].params[0])
        for other in range(3):
            was, here = rig.cam_from_rig[other], now.cam_from_rig[other]
            turned = np.linalg.norm(log_rotation(was.rotation @ here.rotation.T))
            expected = 2.0 if other != 0 and index in (0, other) else 0.0
            assert np.degrees(turned) == pytest.approx(expected, abs=1e-9)
            apart = [float(np.linalg.norm(t.translation)) for t in (was, here)]
            assert apart[0] == pytest.approx(apart[1])  # about its own centre
    with pytest.raises(CalibrationError, match="no camera 'cam9'"):
        touched(rig, Changed(camera="cam9"))


# ---- trials --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Mapping[str, Cell], Path]:
    """The row of a rig that was touched, and what its trial left."""
    folder = tmp_path_factory.mktemp("trials") / "one"
    changed = {"changed.camera": "cam1", "changed.turn_deg": 2.0, "depth_ranges": []}
    return trial(options(command="recalibrate", **TRACKS, **changed), 1, folder), folder


def test_a_trial_is_a_recalibration_by_the_product(
    finished: tuple[Mapping[str, Cell], Path],
) -> None:
    row, folder = finished
    left = load_calibration(folder / "calibration.json")
    assert left.recalibration is not None and left.recalibration.drift is not None
    assert row["drift"] == left.recalibration.drift.verdict == "replace"
    assert row["drifted"] == "cam0, or cam1"  # of two cameras it cannot be told which
    assert isinstance(row["p"], float) and row["p"] < 0.01 and "elsewhere" in str(row["change"])
    assert row == {**row, **row_of(left)}
    assert not (folder / "report.html").exists()
    assert left.provenance.created is not None


def test_a_row_has_every_parameter_with_its_sigma(
    finished: tuple[Mapping[str, Cell], Path],
) -> None:
    row, folder = finished
    left = load_calibration(folder / "calibration.json")
    for name, sigma in zip(
        left.covariance.names, np.sqrt(np.diag(left.covariance.matrix)), strict=True
    ):
        unit = 180 / np.pi if ".rotation_" in name else 1.0
        assert row[f"{name}.sigma"] == pytest.approx(unit * sigma), name
    assert row["cam1.fx"] == left.cameras["cam1"].params["fx"]
    assert row["cam1.baseline"] == pytest.approx(
        np.linalg.norm(left.rig.cam_from_rig["cam1"].translation)
    )
    assert {"seconds_solving_weak", "rms_px", "noise_px", "n_frames", "converged"} <= set(row)


def test_z_is_the_error_by_the_truth_over_the_sigma(
    finished: tuple[Mapping[str, Cell], Path],
) -> None:
    row, _ = finished
    fx = make_rig("stereo", "radial").cameras[0].params[0]
    z = (float(str(row["cam0.fx"])) - fx) / float(str(row["cam0.fx.sigma"]))
    assert row["cam0.fx.z"] == pytest.approx(z)
    assert 0 < float(str(row["z_rms"])) < 2.5 and float(str(row["error_px"])) > 0


def test_a_calibration_far_off_its_truth_shows(
    finished: tuple[Mapping[str, Cell], Path], tmp_path: Path
) -> None:
    _, folder = finished
    left = load_calibration(folder / "calibration.json")
    truth = left.model_copy(deep=True)
    truth.cameras["cam0"].params["fx"] += 20 * left.cameras["cam0"].sigma["fx"]
    save_calibration(
        truth.model_copy(update={"covariance": type(left.covariance)()}), tmp_path / "t.json"
    )
    here = rig_of(left, folder)
    far = truth_columns(here, read_calibration(tmp_path / "t.json"))
    assert far["cam0.fx.z"] == pytest.approx(-20.0)
    assert float(str(far["z_rms"])) > 3 and float(str(far["truth_p"])) < 1e-3


def test_the_same_seed_gives_the_same_row_and_another_another(tmp_path: Path) -> None:
    one = options(**TRACKS | {"simulate.rig": "mono", "lens": "radial"})
    rows = [trial(one, seed, tmp_path / f"{i}") for i, seed in enumerate((5, 5, 6))]
    untimed = [{k: v for k, v in row.items() if not k.startswith("seconds")} for row in rows]
    assert untimed[0] == untimed[1] != untimed[2]


def test_a_refused_trial_leaves_nothing(tmp_path: Path) -> None:
    """In the product's own words."""
    blank(tmp_path / "scan" / "0.png", (64, 64))
    with pytest.raises(CalibrationError, match="1 readable image, and a calibration needs"):
        trial(options(scan=tmp_path / "scan"), 0, tmp_path / "trials" / "one")
    assert not (tmp_path / "trials" / "one").exists()


@pytest.mark.slow
def test_trials_at_once_on_one_rendered_scan_map_it_once(tmp_path: Path) -> None:
    pytest.importorskip("open3d", reason="the simulator needs open3d (the extra `depth`)")
    rendered = {"simulate.rig": "stereo", "simulate.frames": 8, "simulate.size": [320, 240]}
    rendered |= {"simulate.supersampling": 1, "max_features": 250, "lens": "radial"}
    asked = [options(simulate="images", loss=loss, **rendered) for loss in ("huber", "cauchy")]
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        runs = [pool.submit(trial, o, 0, tmp_path / f"{i}") for i, o in enumerate(asked)]
        rows = [run.result() for run in runs]
    assert rows[0]["n_images"] == rows[1]["n_images"] == 16
    assert rows[0]["cam0.fx"] != rows[1]["cam0.fx"]
    made = [path.name.partition(".")[0] for path in (tmp_path / CACHE).iterdir() if path.is_dir()]
    assert sorted(made) == ["features", "matches", "models", "simulation"]
    for i, row in enumerate(rows):
        assert (tmp_path / f"{i}" / "report.html").exists()
        assert abs(float(str(row["cam0.fx.z"]))) < 6


# ---- configs -------------------------------------------------------------------------------


def test_the_fleet_example_is_a_fleet_once_its_paths_are_there(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = ROOT / "configs/fleet.yaml"
    monkeypatch.chdir(tmp_path)
    before = {trial.key for trial in trials_of(load_study(path))}
    content = yaml.safe_load(path.read_text())
    rig = make_rig("stereo")
    for one in content["list"]:
        for key in {"old", "scan", "truth", "board", "board_images"} & set(one):
            place = Path(one[key])
            place.parent.mkdir(parents=True, exist_ok=True)
            if key == "scan":
                place.symlink_to(scan)
            else:
                place.write_text(json.dumps(rig.cameras[0].named()))
    trials = trials_of(load_study(path))
    assert not before & {trial.key for trial in trials}
    assert len(trials) == len(content["list"]) and len({t.options.name for t in trials}) == len(
        trials
    )
    assert all(t.options.command == "recalibrate" for t in trials)
    # Another old calibration is another trial, and so is another image.
    Path(content["list"][0]["old"]).write_text("{}")
    now = trials_of(load_study(path))
    assert now[0].key != trials[0].key and [t.key for t in now[1:]] == [t.key for t in trials[1:]]


def test_the_fleet_to_try_needs_no_files() -> None:
    trials = trials_of(load_study(ROOT / "configs/studies/calibrations.yaml"))
    changed = [t for t in trials if any(key.startswith(CHANGED) for key in t.options.said)]
    assert 0 < len(changed) < len(trials)
    assert all(not STUDY.inputs(t.options) for t in trials)
