"""Stages that need not run twice, and whole files or none."""

import errno
import os
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from sfm_calib import cache as cache_module
from sfm_calib import files
from sfm_calib.cache import Cache
from sfm_calib.errors import CalibrationError
from sfm_calib.files import sha256, write_atomically


class Stage:
    """A stage that counts how often it runs."""

    def __init__(self):
        self.runs = 0

    def __call__(self, place):
        self.runs += 1
        (place / "result").write_text(f"run {self.runs}")


@pytest.fixture
def make():
    return Stage()


def test_a_finished_stage_is_reused(tmp_path, make):
    first = Cache(tmp_path).stage("a", {"x": 1}, make)
    again = Cache(tmp_path).stage("a", {"x": 1}, make)
    assert make.runs == 1 and first == again and (again / "result").read_text() == "run 1"


@pytest.mark.parametrize("inputs", [{"x": 2}, {"y": 1}, {"x": 1, "y": 1}, {"x": "1"}, {"x": [1]}])
def test_other_inputs_make_it_again(tmp_path, make, inputs):
    Cache(tmp_path).stage("a", {"x": 1}, make)
    place = Cache(tmp_path).stage("a", inputs, make)
    assert make.runs == 2 and (place / "result").read_text() == "run 2"


def test_stages_are_apart(tmp_path, make):
    Cache(tmp_path).stage("a", 1, make)
    Cache(tmp_path).stage("b", 2, make)
    Cache(tmp_path).stage("a", 1, make)
    assert make.runs == 2


def test_fresh_ignores_what_was_left(tmp_path, make):
    Cache(tmp_path).stage("a", 1, make)
    Cache(tmp_path, fresh=True).stage("a", 1, make)
    assert make.runs == 2
    Cache(tmp_path).stage("a", 1, make)
    assert make.runs == 2


def test_a_stage_that_was_killed_is_made_again_from_nothing(tmp_path, make):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "half").write_text("")
    place = Cache(tmp_path).stage("a", 1, make)
    assert make.runs == 1 and [path.name for path in place.iterdir()] == ["result"]


@pytest.mark.parametrize("damage", ["folder", "key", "binary key"])
def test_a_damaged_cache_is_made_again(tmp_path, make, damage):
    place = Cache(tmp_path).stage("a", 1, make)
    if damage == "folder":
        (place / "result").unlink()
        place.rmdir()
    else:
        (tmp_path / "a.key").write_bytes(b"\xff\xfe" if "binary" in damage else b"")
    Cache(tmp_path).stage("a", 1, make)
    assert make.runs == 2


@pytest.mark.parametrize("error", [KeyboardInterrupt, CalibrationError, RuntimeError])
def test_a_stage_that_fails_leaves_nothing_that_looks_done(tmp_path, make, error):
    def fail(place):
        (place / "half").write_text("")
        raise error

    Cache(tmp_path / "cache").stage("a", 1, make)
    with pytest.raises(error):
        Cache(tmp_path / "cache").stage("a", 2, fail)
    assert not (tmp_path / "cache").exists()  # nothing is left to keep it for


def test_a_full_disk_is_said_and_freed(tmp_path):
    def fail(place):
        (place / "half").write_text("")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(CalibrationError, match=r"cannot write .*/a: No space left .*; free some"):
        Cache(tmp_path).stage("a", 1, fail)
    assert not (tmp_path / "a").exists()


def test_a_full_disk_that_a_library_hides(tmp_path, monkeypatch):
    def fail(place):
        raise RuntimeError("No registered database factory succeeded.")

    with pytest.raises(RuntimeError):
        Cache(tmp_path).stage("a", 1, fail)
    monkeypatch.setattr(cache_module, "DISK_IS_FULL", 1 << 62)
    with pytest.raises(CalibrationError, match="MB are free"):
        Cache(tmp_path).stage("a", 1, fail)


# ---- shared by runs that go on at once ----------------------------------------------------------


def test_a_shared_cache_keeps_a_stage_for_each_of_its_inputs(tmp_path, make):
    cache = Cache(tmp_path, shared=True)
    first, second = cache.stage("a", 1, make), cache.stage("a", 2, make)
    assert make.runs == 2 and first != second
    assert cache.stage("a", 1, make) == first and make.runs == 2
    assert (first / "result").read_text() == "run 1" and (second / "result").read_text() == "run 2"


def test_what_one_run_makes_the_others_wait_for(tmp_path, make):
    def slowly(place):
        time.sleep(0.1)
        make(place)

    with ThreadPoolExecutor(6) as pool:
        runs = [
            pool.submit(Cache(tmp_path, shared=True).stage, "a", n % 2, slowly) for n in range(6)
        ]
        places = [run.result() for run in runs]
    assert make.runs == 2 and len(set(places)) == 2
    assert all((place / "result").exists() for place in places)


def test_a_shared_stage_that_fails_is_made_by_the_next(tmp_path, make):
    cache = Cache(tmp_path, shared=True)

    def fail(place):
        (place / "half").write_text("")
        raise CalibrationError("no overlap")

    for _ in range(2):
        with pytest.raises(CalibrationError):
            cache.stage("a", 1, fail)
    place = cache.stage("a", 1, make)
    assert make.runs == 1 and [path.name for path in place.iterdir()] == ["result"]


def test_a_stage_is_held_by_one_at_a_time(tmp_path, make):
    """COLMAP aborts where two processes open one database."""
    cache = Cache(tmp_path, shared=True)
    place, inside = cache.stage("a", 1, make), []

    def use(number):
        with cache.held(place):
            inside.append(number)
            time.sleep(0.02)
            assert inside[-1] == number
            inside.append(-number)

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(use, range(1, 9)))
    assert [a + b for a, b in zip(inside[::2], inside[1::2], strict=True)] == [0] * 8


# ---- files -------------------------------------------------------------------------------------


def test_a_file_is_written_whole(tmp_path):
    write_atomically(tmp_path / "new" / "a.json", "Käm")
    write_atomically(tmp_path / "new" / "a.json", b"other")
    assert (tmp_path / "new" / "a.json").read_bytes() == b"other"
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["a.json"]
    assert (tmp_path / "new" / "a.json").stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize("where", ["fsync", "replace"])
def test_the_old_file_survives_a_failure(tmp_path, monkeypatch, where):
    write_atomically(tmp_path / "a", "old")

    def fail(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(files.os, where, fail)
    with pytest.raises(CalibrationError, match="No space left on device; free some space"):
        write_atomically(tmp_path / "a", "new")
    monkeypatch.undo()
    assert (tmp_path / "a").read_text() == "old" and len(list(tmp_path.iterdir())) == 1


def test_a_path_under_a_file(tmp_path):
    (tmp_path / "a").write_text("")
    with pytest.raises(CalibrationError, match="cannot write"):
        write_atomically(tmp_path / "a" / "b", "new")


def test_sha256(tmp_path):
    (tmp_path / "a").write_bytes(b"")
    assert sha256(tmp_path / "a").startswith("e3b0c44298fc1c149afbf4c8996fb924")
