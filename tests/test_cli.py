"""The command line: exit codes, one clear line for bad input, and nothing lost."""

import contextlib
import io
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time

import pytest
from synthetic.scans import DATA, QUICK, panning_frames, picture, simulation, video
from test_result import rig

import sfm_calib
from sfm_calib import cli
from sfm_calib.cli import main
from sfm_calib.config import Options
from sfm_calib.errors import CalibrationError
from sfm_calib.result import load_calibration, save_calibration


def rig_of_noise(scan):
    for camera in ("left", "right"):
        for number in range(3):
            picture(scan / camera / f"{number}.png")
    return scan


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


# ---- bad input ---------------------------------------------------------------------------------


def _rig_file(text):
    def make(folder):
        (rig_of_noise(folder / "scan") / "rig.yaml").write_text(text)
        return folder / "scan"

    return make


def _empty(folder):
    (folder / "scan").mkdir()
    return folder / "scan"


def _one_image(folder):
    return picture(folder / "scan" / "0.png").parent


def _sizes(folder):
    picture(rig_of_noise(folder / "scan") / "left" / "7.png", size=(64, 48))
    return folder / "scan"


def _text_file(folder):
    (folder / "notes.txt").write_text("no scan")
    return folder / "notes.txt"


def _broken_video(folder):
    (folder / "walk.mp4").write_bytes(b"no video")
    return folder / "walk.mp4"


def _still_video(folder):
    return video(folder / "still.avi", panning_frames(1) * 5)


BAD_SCANS = {
    "no such folder": (lambda folder: folder / "nowhere", [], "no such scan"),
    "an empty folder": (_empty, [], "holds no images"),
    "one image": (_one_image, [], "holds 1 readable image,"),
    "sizes differ": (_sizes, [], "camera left: 7.png is 64x48"),
    "a text file": (_text_file, [], "notes.txt is no video"),
    "a broken video": (_broken_video, [], "walk.mp4 gave 0 frames"),
    "a still video": (_still_video, [], "move the camera while it films"),
    "unknown key": (_rig_file("lense: radtan"), [], "unknown key 'lense': did you mean 'lens'?"),
    "wrong type": (_rig_file("seed: x"), [], "seed: Input should be a valid integer"),
    "unknown camera": (_rig_file("reference: lift"), [], "did you mean 'left'?"),
    "no mapping": (_rig_file("[1, 2]"), [], "holds one list, not keys and values"),
    "invalid YAML": (_rig_file("lens: {"), [], "is not valid YAML"),
    "a flag out of range": (_rig_file(""), ["--max-features", "5"], "--max-features: Input should"),
    "a flag's unknown camera": (_rig_file(""), ["--reference", "top"], "a camera 'top'"),
    "no truth": (_rig_file(""), ["--truth", "/nowhere/truth.json"], "cannot read /nowhere/truth"),
}


@pytest.mark.parametrize(("make", "flags", "message"), BAD_SCANS.values(), ids=BAD_SCANS)
@pytest.mark.parametrize("before", ["an earlier result", "nothing"])
def test_bad_input(tmp_path, capfd, make, flags, message, before):
    scan, out = make(tmp_path), tmp_path / "new" / "out"
    if before != "nothing":
        save_calibration(rig(), out / "calibration.json")
        kept = (out / "calibration.json").read_bytes()
    assert main(["calibrate", str(scan), "-o", str(out), *flags]) == 2
    printed = capfd.readouterr()  # of the process: decoders write past sys.stderr
    lines = [line for line in printed.err.splitlines() if not line.startswith(PROGRESS)]
    assert printed.out == "" and len(lines) == 1, printed.err
    assert lines[0].startswith("sfm-calib: ") and message in lines[0]
    if before == "nothing":
        assert not (tmp_path / "new").exists()
    else:
        assert [path.name for path in out.iterdir()] == ["calibration.json"]
        assert (out / "calibration.json").read_bytes() == kept


PROGRESS = ("reading images", "scanning ")


@pytest.mark.parametrize(
    ("out", "reason"),
    [
        ("file", "it is a file"),
        ("file/x/y", "Not a directory"),
        ("/proc/x", "No such file or directory"),
    ],
)
def test_out_that_cannot_be_written(tmp_path, capsys, out, reason):
    rig_of_noise(tmp_path / "scan")
    (tmp_path / "file").write_text("mine")
    assert main(["calibrate", str(tmp_path / "scan"), "-o", str(tmp_path / out)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("sfm-calib: cannot write to") and f"{reason}; choose another" in line
    assert (tmp_path / "file").read_text() == "mine"


def test_a_disk_with_little_room(tmp_path, capsys, monkeypatch):
    rig_of_noise(tmp_path / "scan")
    monkeypatch.setattr(cli, "LEAST_FREE", 1 << 62)
    assert main(["calibrate", str(tmp_path / "scan"), "-o", str(tmp_path / "out")]) == 2
    assert "MB are free in" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_a_truth_of_other_cameras_is_refused_before_the_work(tmp_path, capsys):
    scan = rig_of_noise(tmp_path / "scan")
    save_calibration(rig(("left",)), tmp_path / "truth.json")
    flags = ["--truth", str(tmp_path / "truth.json")]
    assert main(["calibrate", str(scan), "-o", str(tmp_path / "out"), *flags]) == 2
    assert "give the truth of this scan" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["callibrate"],
        ["calibrate", "scan"],
        ["calibrate", "-o", "out"],
        ["calibrate", "scan", "-o", "out", "--lens", "foo"],
        ["calibrate", "scan", "-o", "out", "--seed", "1.5"],
        ["calibrate", "scan", "-o", "out", "--no-such-flag"],
    ],
    ids=shlex.join,
)
def test_bad_flags(capsys, arguments):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    printed = capsys.readouterr()
    assert caught.value.code == 2 and printed.out == "" and "sfm-calib" in printed.err


def test_an_error_of_the_system_is_one_line(capsys, monkeypatch):
    def fail(*_):
        raise PermissionError(13, "Permission denied", "/secret")

    monkeypatch.setattr(cli, "run", fail)
    assert main(["demo"]) == 2
    assert capsys.readouterr().err == "sfm-calib: /secret: Permission denied\n"


def test_the_demo_spares_a_scan_that_is_no_simulation(tmp_path, capsys):
    mine = picture(tmp_path / "scan" / "mine.png")
    assert main(["demo", "-o", str(tmp_path)]) == 2
    assert "is no simulation, and the demo would replace it" in capsys.readouterr().err
    assert mine.exists()


# ---- a full disk -------------------------------------------------------------------------------


@pytest.fixture
def small_disk(tmp_path):
    """A disk of 3 MB, as root may make one."""
    disk = tmp_path / "disk"
    disk.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", str(disk)]
    if shutil.which("mount") is None or subprocess.run(command, capture_output=True).returncode:
        pytest.skip("mounting a small disk is not allowed here")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


def test_a_disk_that_fills_halfway(small_disk, capfd, monkeypatch):
    monkeypatch.setattr(cli, "LEAST_FREE", 0)  # it fills up later than at the start
    out = small_disk / "out"
    save_calibration(rig(), out / "calibration.json")
    kept = (out / "calibration.json").read_bytes()
    assert main(["calibrate", str(simulation() / "scan"), "-o", str(out)]) == 2
    last = capfd.readouterr().err.splitlines()[-1]  # COLMAP aborts its process with a stack trace
    assert last.startswith("sfm-calib: cannot write") and "free some space or choose" in last
    assert (out / "calibration.json").read_bytes() == kept
    assert sorted(path.name for path in out.rglob("*")) == ["calibration.json"]


@pytest.mark.parametrize("fails", ["write_report", "save_calibration"])
def test_results_are_written_both_or_none(tmp_path, finished, capsys, monkeypatch, fails):
    out = tmp_path / "out"
    shutil.copytree(finished[0], out)
    before = {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()}
    assert set(before) == {"calibration.json", "report.html"}

    def fail(*_):
        raise CalibrationError("cannot write OUT: No space left on device")

    monkeypatch.setattr(cli, "write_report", lambda *args: args[3].write_text("new"))
    monkeypatch.setattr(cli, fails, fail)
    outcome = type("Outcome", (), {"refinement": _Anything(), "calibration": rig(), "unit": 1.0})()
    with pytest.raises(CalibrationError):
        cli.write_results(outcome, out, [])
    assert {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()} == before


class _Anything:
    def __getattr__(self, name):
        return self

    def __call__(self, *_):
        return self


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
    for part in ("cam0: radtan, 320 x 240 px, 8 images", "cam1.rotation_z", "report.html written"):
        assert part in text
    stages = [line.split(" ")[0] for line in text.splitlines() if line[:1].islower()]
    positions = [
        stages.index(stage)
        for stage in ("reading", "extracting", "matching", "mapping", "solving", "covariance")
    ]
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


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"sfm-calib {sfm_calib.__version__}\n"


@pytest.mark.parametrize("command", ["calibrate", "simulate", "simulate-tracks", "demo"])
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


def stop_at(stage, how, out):
    """Start the program, and stop it where the stage begins. Its exit code and the delay."""
    command = [sys.executable, "-m", "sfm_calib", *arguments_of(simulation() / "scan", out)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
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
    assert stages == {"reading", "solving", "covariance"}
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
