"""Bad input: one clear line, exit code 2, nothing written and nothing lost."""

import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from synthetic.scans import panning_frames, picture, simulation, video
from test_result import rig

from sfm_calib import cli, output
from sfm_calib.cli import main
from sfm_calib.errors import CalibrationError
from sfm_calib.result import save_calibration


def rig_of_noise(scan):
    for camera in ("left", "right"):
        for number in range(3):
            picture(scan / camera / f"{number}.png")
    return scan


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


def _still_video(folder):
    return video(folder / "still.avi", panning_frames(1) * 5)


BAD_SCANS = {
    "no such folder": (lambda folder: folder / "nowhere", [], "no such scan"),
    "an empty folder": (_empty, [], "holds no images"),
    "one image": (_one_image, [], "holds 1 readable image,"),
    "sizes differ": (_sizes, [], "camera left: 7.png is 64x48"),
    "a text file": (_text_file, [], "notes.txt is no video"),
    "a still video": (_still_video, [], "move the camera while it films"),
    "unknown key": (_rig_file("lense: radtan"), [], "unknown key 'lense': did you mean 'lens'?"),
    "wrong type": (_rig_file("seed: x"), [], "seed: Input should be a valid integer"),
    "unknown camera": (_rig_file("reference: lift"), [], "did you mean 'left'?"),
    "no mapping": (_rig_file("[1, 2]"), [], "holds one list, not keys and values"),
    "invalid YAML": (_rig_file("lens: {"), [], "is not valid YAML"),
    "a flag out of range": (_rig_file(""), ["--max-features", "5"], "--max-features: Input should"),
    "a flag's unknown camera": (_rig_file(""), ["--reference", "top"], "has no camera 'top'"),
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
    monkeypatch.setattr(output, "LEAST_FREE", 1 << 62)
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


@pytest.mark.slow
def test_a_disk_that_fills_halfway(small_disk, capfd, monkeypatch):
    monkeypatch.setattr(output, "LEAST_FREE", 0)  # it fills up later than at the start
    out = small_disk / "out"
    save_calibration(rig(), out / "calibration.json")
    kept = (out / "calibration.json").read_bytes()
    assert main(["calibrate", str(simulation() / "scan"), "-o", str(out)]) == 2
    last = capfd.readouterr().err.splitlines()[-1]  # COLMAP aborts its process with a stack trace
    assert last.startswith("sfm-calib: cannot write") and "free some space or choose" in last
    assert (out / "calibration.json").read_bytes() == kept
    assert sorted(path.name for path in out.rglob("*")) == ["calibration.json"]


@pytest.mark.parametrize("fails", ["write_report", "save_calibration"])
def test_results_are_written_both_or_none(tmp_path, monkeypatch, fails):
    out = tmp_path / "out"
    save_calibration(rig(), out / "calibration.json")
    (out / "report.html").write_text("old")
    before = {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()}

    def fail(*_):
        raise CalibrationError("cannot write OUT: No space left on device")

    monkeypatch.setattr(output, "write_report", lambda *args: args[3].write_text("new"))
    monkeypatch.setattr(output, fails, fail)
    outcome = type("Outcome", (), {"refinement": _Anything(), "calibration": rig(), "unit": 1.0})()
    with pytest.raises(CalibrationError):
        output.write_results(outcome, out, [])
    assert {p.name: p.read_bytes() for p in out.iterdir() if p.is_file()} == before


class _Anything:
    def __getattr__(self, name):
        return self

    def __call__(self, *_):
        return self


@pytest.mark.slow
def test_decoders_leave_the_word_to_us(tmp_path):
    (tmp_path / "walk.mp4").write_bytes(b"no video")
    command = ["calibrate", str(tmp_path / "walk.mp4"), "-o", str(tmp_path / "out")]
    run = [sys.executable, "-m", "sfm_calib", *command]  # FFmpeg listens once a process
    done = subprocess.run(run, capture_output=True, text=True)
    assert done.returncode == 2 and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("sfm-calib: ") and "walk.mp4 gave 0 frames" in line


def test_results_do_not_go_among_the_images(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scan = tmp_path / "scan"
    (scan / "left").mkdir(parents=True)
    for command in (["calibrate"], ["recalibrate", str(tmp_path / "old.json")]):
        assert main([*command, str(scan), "-o", str(scan / "left" / "..")]) == 2
        assert "is the scan itself" in capsys.readouterr().err
    assert [path.name for path in scan.iterdir()] == ["left"]
