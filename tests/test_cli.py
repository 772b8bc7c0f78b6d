"""The command line: exit codes, one clear line for bad input, and nothing lost."""

import contextlib
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time

import pytest
from synthetic.scans import DATA, QUICK, panning_frames, simulation, video

import sfm_calib
from sfm_calib import cli
from sfm_calib.cli import main
from sfm_calib.config import Options
from sfm_calib.result import load_calibration


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """OUT of a calibration with its cache, and what it printed. Copy before you change it."""
    out = tmp_path_factory.mktemp("finished") / "out"
    truth = simulation() / "truth.json"
    with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.redirect_stderr(text):
        code = main(arguments_of(simulation() / "scan", out, "--truth", str(truth)))
    assert code == 0, text.getvalue()
    return out, text.getvalue()


def arguments_of(scan, out, *more):
    return ["calibrate", str(scan), "-o", str(out), *QUICK, *more]


# ---- what works --------------------------------------------------------------------------------


def test_a_calibration_is_written_and_printed(finished):
    out, text = finished
    assert sorted(path.name for path in out.iterdir()) == [
        *("cache", "calibration.json", "report.html")
    ]
    calibration = load_calibration(out / "calibration.json")
    assert set(calibration.cameras) == {"cam0", "cam1"}
    assert calibration.provenance.config["max_features"] == 250
    assert calibration.provenance.command.startswith("sfm-calib calibrate")
    assert calibration.provenance.created is not None
    written = (out / "calibration.json").stat().st_mtime
    assert abs(calibration.provenance.created.timestamp() - written) < 60
    for part in (", 320 x 240 px, 8 images", "cam1.rotation_z", "report.html written"):
        assert part in text
    stages = [line.split(" ")[0] for line in text.splitlines() if line[:1].islower()]
    order = ("reading", "extracting", "matching", "mapping", "choosing", "solving", "covariance")
    positions = [stages.index(stage) for stage in order]
    assert positions == sorted(positions)


def test_json_is_all_of_stdout_and_the_cache_is_used(tmp_path, finished, capfd):
    out = tmp_path / "out"
    shutil.copytree(finished[0], out)
    assert main(arguments_of(simulation() / "scan", out, "--json")) == 0
    printed = capfd.readouterr()
    again = json.loads(printed.out)
    assert not {"extracting", "matching", "mapping"} & {
        line.split(" ")[0] for line in printed.err.splitlines()
    }
    first = json.loads((finished[0] / "calibration.json").read_text())
    assert again["cameras"] == first["cameras"] and again["rig"] == first["rig"]
    assert json.loads((out / "calibration.json").read_text()) == again
    for told in (first, again):  # all else is the same when made again
        assert told["provenance"].pop("created") and told["provenance"].pop("command")
        assert told["solve"].pop("seconds")
    assert again == first


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"sfm-calib {sfm_calib.__version__}\n"


@pytest.mark.parametrize(
    "command",
    ["calibrate", "history", "undistort", "rectify", "simulate", "simulate-tracks", "demo"],
)
def test_every_flag_is_explained(capsys, command):
    with pytest.raises(SystemExit) as caught:
        main([command, "--help"])
    text = capsys.readouterr().out
    assert caught.value.code == 0 and "{None}" not in text
    words = " ".join(line.strip("│╭╮╰╯─ ") for line in text.splitlines())
    assert not re.search(r"--[a-z-]+( [A-Z{]\S*)* \(", words), "a flag without an explanation"
    if command == "calibrate":
        assert all(f"--{name.replace('_', '-')}" in text for name in Options.model_fields)


# ---- precedence --------------------------------------------------------------------------------


@pytest.fixture
def used(tmp_path, monkeypatch):
    """What the calibration is asked for, given rig.yaml and flags."""

    class AskedError(Exception):
        pass

    def calibrate(scan, config, cache, progress, command):
        raise AskedError(config, cache.fresh)

    monkeypatch.setattr(cli, "calibrate", calibrate)

    def use(text, *flags):
        scan = tmp_path / "scan"
        scan.mkdir(exist_ok=True)
        (scan / "rig.yaml").write_text(text)
        with pytest.raises(AskedError) as caught:
            main(["calibrate", str(scan), "-o", str(tmp_path / "out"), *flags])
        return caught.value.args

    return use


def test_flags_go_before_the_file_and_the_file_before_defaults(used):
    default = Options()
    assert used("")[0].options() == default
    config, _ = used("max_features: 500\nlens: pinhole\ncameras: {left: {lens: radial}}")
    assert (config.max_features, config.lens, config.seed) == (500, "pinhole", default.seed)
    assert config.cameras["left"].lens == "radial"
    config, _ = used("max_features: 500\nlens: pinhole", "--max-features", "700")
    assert (config.max_features, config.lens) == (700, "pinhole")


def test_a_flag_set_to_the_default_overrides_the_file(used):
    default = Options()
    flags = ["--max-features", str(default.max_features), "--lens", default.lens]
    config, _ = used("max_features: 500\nlens: pinhole\nseed: 4\nreference: left", *flags)
    assert (config.max_features, config.lens, config.seed) == (8192, "auto", 4)
    assert used("reference: left", "--reference", "None")[0].reference is None


def test_fresh(used):
    assert [used("", *flags)[1] for flags in ([], ["--fresh"])] == [False, True]


def test_rig_yaml_lies_beside_a_video(tmp_path):
    path = video(tmp_path / "walk.avi", panning_frames(3))
    assert cli.rig_file(path) == tmp_path / "rig.yaml"
    assert cli.rig_file(tmp_path) == tmp_path / "rig.yaml"


@pytest.mark.parametrize("flags", [[], ["-v"]])
def test_verbose_shows_colmaps_log(used, monkeypatch, flags):
    said = []
    monkeypatch.setattr(cli, "quiet", said.append)
    used("", *flags)
    assert said == [bool(flags)]


# ---- interruptions -----------------------------------------------------------------------------


def test_an_interrupt_is_no_traceback(capsys, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "run", interrupt)
    assert main(["demo"]) == 130
    assert capsys.readouterr().err.startswith("sfm-calib: interrupted")


def test_being_told_to_end_is_an_interrupt(capsys, monkeypatch):
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(cli, "run", lambda *_: os.kill(os.getpid(), signal.SIGTERM))
    try:
        assert main(["demo"]) == 130
    finally:
        signal.signal(signal.SIGTERM, before)
    assert capsys.readouterr().err.startswith("sfm-calib: interrupted")


def heed_interrupts():
    """A background job is born deaf to Ctrl-C, and so are its children."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def stop_at(stage, how, out):
    """Start the program, and stop it where the stage begins. Its exit code and the delay."""
    command = [sys.executable, "-m", "sfm_calib", *arguments_of(simulation() / "scan", out)]
    process = subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=heed_interrupts,
    )
    with process:
        for line in process.stderr:
            if line.startswith(stage):
                break
        begin = time.monotonic()
        os.kill(process.pid, how)
        rest = process.stderr.read()
        code = process.wait()
    return code, time.monotonic() - begin, rest


def keys(out):
    return sorted(path.stem for path in (out / "cache").glob("*.key"))


@pytest.mark.slow
def test_stopped_runs_are_resumed(tmp_path, capfd):
    out = tmp_path / "out"
    code, _, _ = stop_at("mapping", signal.SIGKILL, out)
    assert code == -signal.SIGKILL and keys(out) == ["features", "matches"]
    code, delay, text = stop_at("solving", signal.SIGINT, out)
    assert (code, keys(out)) == (130, ["features", "matches", "models"]) and delay < 3
    assert text.splitlines()[-1].startswith("sfm-calib: interrupted") and "Traceback" not in text
    assert [path.name for path in out.iterdir()] == ["cache"]
    assert main(arguments_of(simulation() / "scan", out)) == 0
    stages = {line.split(" ")[0] for line in capfd.readouterr().err.splitlines()}
    assert stages == {"reading", "choosing", "solving", "covariance", "leaving"}
    assert (out / "calibration.json").exists()


def test_a_reader_that_has_read_enough(capfd, monkeypatch):
    def fail(*_):
        raise BrokenPipeError(32, "Broken pipe")

    monkeypatch.setattr(cli, "run", fail)
    assert main(["demo"]) == 0
    print("to nobody", flush=True)
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
def test_a_real_scan_with_blanks_in_its_names(tmp_path):
    scan = DATA / "corridor_stereo" / "scan"
    if not scan.is_dir():
        pytest.skip("../shared/data/corridor_stereo is not on this machine")
    for camera in ("left", "right"):
        target = tmp_path / "mein scän" / f"Käm {camera}"
        target.mkdir(parents=True)
        for path in sorted((scan / camera).iterdir())[:20]:
            shutil.copy(path, target / f"Bild {path.name}")
    out = tmp_path / "out dir"
    assert main(["calibrate", str(tmp_path / "mein scän"), "-o", str(out)]) == 0
    assert set(load_calibration(out / "calibration.json").cameras) == {"Käm left", "Käm right"}
