"""The story of a recalibration, from a scan that is mapped already."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pytest
from synthetic.earlier import NAMES
from synthetic.recalibrations import (
    already_mapped,
    deployed,
    mapped,
    measured_m,
    moved,
    pictures,
    recalibrated,
    written,
)

from graphs.frames import Transform, log_rotation
from graphs.propagation import lens_names, marginal, pose_names
from sfm_calib import recalibrate as story
from sfm_calib.cli import main
from sfm_calib.errors import CalibrationError
from sfm_calib.files import calibration_sha256
from sfm_calib.formats import read_calibration
from sfm_calib.formats.reading import NO_SIZE, NOTHING, CameraRig
from sfm_calib.partial import reference_of, seen_from, stated_of
from sfm_calib.recalibrate import Recalibrated
from sfm_calib.result import Calibration, load_calibration

MEASURED = {
    "scale": {"baseline": {"cameras": ("cam0", "cam1"), "length_m": measured_m(), "sigma_m": 2e-4}}
}


@cache
def found(case: str) -> Recalibrated:
    """One run of the story for every test that looks at it."""
    old = deployed()
    cases: dict[str, tuple[CameraRig, dict[str, object]]] = {
        "weak": (old, {}),
        "start": (old, {"prior": "start"}),
        "full": (old, {"prior": "full"}),
        "turned": (moved(old, "cam2", turn_deg=1.0), {"prior": "full"}),
        "rotation": (old, {"free": ("cam2.rotation",)}),
        "lens": (moved(old, "cam1", focal=1.02), {"free": ("cam1.intrinsics",)}),
        "lacks cam2": (old, {"scan_at": pictures(("cam0", "cam1"))}),
        "lacks cam0": (old, {"scan_at": pictures(("cam1", "cam2"))}),
        "lone": (old, {"scan_at": pictures(("cam1",))}),
        "new": (old.only(["cam0", "cam1"]), {"prior": "full"}),
        "reference": (old, {"config": {"reference": "cam1"}}),
        "measured": (old, {"config": MEASURED}),
        "too large": (larger(old, 1.02), {"config": MEASURED}),
        "no metres": (replace(old, unit="unknown"), {"config": MEASURED}),
        "no metres anywhere": (replace(old, unit="unknown"), {}),
        "no sigmas": (
            replace(old, covariance=NOTHING),
            {"free": ("intrinsics",), "scan_at": pictures(("cam0", "cam1"))},
        ),
    }
    rig, options = cases[case]
    with pytest.MonkeyPatch.context() as patch:
        already_mapped(patch)
        return recalibrated(rig, Path(mkdtemp()), **options)  # type: ignore[arg-type]


def larger(old: CameraRig, by: float) -> CameraRig:
    assert old.cam_from_rig
    return replace(old, cam_from_rig=tuple(t.scaled(by) for t in old.cam_from_rig))


def result(case: str) -> Calibration:
    return found(case).outcome.calibration


def said(case: str) -> str:
    verdict = result(case).verdict
    assert verdict
    return "\n".join(verdict.messages)


def in_sigmas(calibration: Calibration, names: tuple[str, ...] = NAMES) -> list[float]:
    """How far lenses are from the truth."""
    truth = mapped()[1].cameras
    return [
        (calibration.cameras[c.name].params[p] - v) / calibration.cameras[c.name].sigma[p]
        for c in truth
        if c.name in names
        for p, v in c.named().items()
    ]


# ---- how far the old one is believed ---------------------------------------------------------


@pytest.mark.parametrize("mode", [pytest.param("start", marks=pytest.mark.slow), "weak", "full"])
def test_an_old_calibration_that_holds_is_kept(mode: str) -> None:
    calibration, drift = result(mode), found(mode).drift
    assert drift.verdict == "keep" and drift.detectable_px < drift.matters_px
    record = calibration.recalibration
    assert record and record.prior == mode and record.drift == drift
    assert (record.kept, record.added, record.freed) == ((), (), ("all",))
    assert calibration.verdict and calibration.verdict.messages == ()
    assert np.sqrt(np.mean(np.square(in_sigmas(calibration)))) < 2
    names = {n for c in deployed().cameras for n in lens_names(c)}
    names |= {n for c in NAMES[1:] for n in pose_names(c)}
    assert set(record.contributions) == names
    shares = [one.prior_share for one in record.contributions.values()]
    assert all(0.02 < s < 0.98 for s in shares) if mode == "full" else max(shares) == 0
    for name, one in record.contributions.items():
        assert one.sigma_old and one.new_alone is not None
        assert abs(one.old - one.result) < 5 * np.hypot(one.sigma_old, one.sigma), name
        if mode != "full":
            assert one.new_alone == one.result


def test_what_is_believed_makes_the_result_surer() -> None:
    ratios = []
    for name in NAMES:
        weak, full = (result(mode).cameras[name].sigma for mode in ("weak", "full"))
        ratios += [full[p] / weak[p] for p in weak]
    assert np.median(ratios) < 0.95 and max(ratios) < 1.1


def test_an_old_calibration_that_the_scan_contradicts_is_not_believed_and_that_is_said() -> None:
    calibration, drift = result("turned"), found("turned").drift
    assert (drift.verdict, drift.moved, drift.drifted) == ("replace", (("cam2",),), ("cam2",))
    record = calibration.recalibration
    assert record and record.prior == "weak"
    assert "was not believed (--prior full)" in said("turned")
    truth = mapped()[1].cam_from_rig[2].rotation
    turned = calibration.cam_from_rig("cam2").rotation @ truth.T
    assert np.degrees(np.linalg.norm(log_rotation(turned))) < 0.1
    # The metres are by cameras that stayed.
    assert "baseline cam0 to cam1 of the old calibration" in calibration.rig.scale.source
    assert "metres are by" not in said("turned")


# ---- what is freed ---------------------------------------------------------------------------


def test_what_is_held_keeps_olds_values_and_sigmas_and_is_not_judged() -> None:
    calibration, drift, old = result("rotation"), found("rotation").drift, deployed()
    tested = {(t.cameras, t.group) for t in drift.tests}
    assert tested == {(("cam2",), "rotation"), (NAMES, "places")}
    assert any("only cam2.rotation was freed" in note for note in drift.notes)
    sigma, record = old.covariance.sigma, calibration.recalibration
    assert record
    for camera in old.cameras:
        now = calibration.cameras[camera.name]
        assert now.params == camera.named()
        for p in camera.names:
            assert now.sigma[p] == pytest.approx(sigma[f"{camera.name}.{p}"], rel=1e-6)
            assert record.contributions[f"{camera.name}.{p}"].prior_share == 1
    place = calibration.cam_from_rig("cam1")
    assert old.cam_from_rig
    np.testing.assert_allclose(place.translation, old.cam_from_rig[1].translation, atol=1e-9)
    np.testing.assert_allclose(place.rotation, old.cam_from_rig[1].rotation, atol=1e-9)
    turned = [record.contributions[n] for n in pose_names("cam2")[:3]]
    assert all(one.prior_share < 1 and one.sigma > 0 for one in turned)


@pytest.mark.slow
def test_a_lens_that_is_freed_alone_is_found_changed() -> None:
    drift = found("lens").drift
    assert drift.verdict == "replace" and drift.drifted == ("cam1",)
    assert {t.cameras for t in drift.tests} == {("cam1",)}
    fx = result("lens").cameras["cam1"].params["fx"]
    assert fx == pytest.approx(mapped()[1].cameras[1].params[0], rel=2e-3)


@pytest.mark.parametrize(
    ("word", "why"),
    [
        ("cam9", "did you mean 'cam"),
        ("cam1.rotaton", "did you mean 'rotation'"),
        ("cam0", "the rig's frame is that of cam0"),
    ],
)
def test_words_that_free_nothing_are_refused(
    word: str, why: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def too_late(*_: object) -> None:
        pytest.fail("mapping takes minutes: a wrong word is to be refused before it")

    monkeypatch.setattr(story, "map_with_prior", too_late)
    with pytest.raises(CalibrationError, match=why):
        recalibrated(deployed(), tmp_path, free=(word,))
    with pytest.raises(ValueError, match="at least 1"):
        recalibrated(deployed(), tmp_path, free=())


# ---- partial rigs ----------------------------------------------------------------------------


def test_a_camera_that_the_scan_lacks_keeps_what_it_had_to_the_bit() -> None:
    calibration, old = result("lacks cam2"), deployed()
    record = calibration.recalibration
    assert record and record.kept == ("cam2",) and calibration.cameras["cam2"].kept_from
    assert calibration.cameras["cam2"].params == old.cameras[2].named()
    own = (*lens_names(old.cameras[2]), *pose_names("cam2"))
    stated = read_rig(calibration)
    np.testing.assert_array_equal(
        marginal(stated.covariance, own).matrix, marginal(old.covariance, own).matrix
    )
    assert old.cam_from_rig
    np.testing.assert_array_equal(
        calibration.cam_from_rig("cam2").translation, old.cam_from_rig[2].translation
    )
    assert not [name for name in record.contributions if name.startswith("cam2")]
    assert "cam2 not in the scan" in said("lacks cam2")


def read_rig(calibration: Calibration) -> CameraRig:
    folder = Path(mkdtemp())
    (folder / "calibration.json").write_text(calibration.model_dump_json())
    return read_calibration(folder)


def test_without_olds_reference_the_frame_is_another_cameras() -> None:
    calibration = result("lacks cam0")
    assert calibration.rig.reference == "cam1" and calibration.rig.metric
    assert found("lacks cam0").drift.cameras == ("cam1", "cam2")
    old = seen_from(stated_of(deployed()), "cam1")
    np.testing.assert_allclose(
        calibration.cam_from_rig("cam0").translation,
        old.estimate.cam_from_rig[0].translation,
    )
    own = pose_names("cam0")
    np.testing.assert_allclose(
        marginal(read_rig(calibration).covariance, own).matrix,
        marginal(old.covariance, own).matrix,
    )


def test_one_common_camera_is_a_lens_alone() -> None:
    calibration, drift = result("lone"), found("lone").drift
    assert {t.group for t in drift.tests} <= {"focal", "principal point", "distortion", "lens"}
    assert calibration.rig.metric and calibration.rig.reference == "cam1"
    assert calibration.recalibration and calibration.recalibration.kept == ("cam0", "cam2")


@pytest.mark.slow
def test_a_camera_that_is_new_to_the_rig_is_added_with_a_lens_that_fits() -> None:
    calibration = result("new")
    record = calibration.recalibration
    assert record and record.added == ("cam2",) and record.prior == "full"
    assert found("new").drift.cameras == ("cam0", "cam1")
    assert calibration.lens_choice and calibration.cameras["cam2"].n_images > 0
    assert max(map(abs, in_sigmas(calibration, ("cam0", "cam1")))) < 5
    true = mapped()[1].cam_from_rig[2].translation
    np.testing.assert_allclose(calibration.cam_from_rig("cam2").translation, true, atol=2e-3)


def test_the_frame_that_is_asked_for_is_that_of_the_result() -> None:
    calibration = result("reference")
    assert calibration.rig.reference == "cam1"
    record = calibration.recalibration
    assert record and set(pose_names("cam0")) <= set(record.contributions)
    for axis, value in zip("xyz", calibration.cam_from_rig("cam0").translation, strict=True):
        one = record.contributions[f"cam0.translation_{axis}"]
        assert one.result == pytest.approx(value)
        assert one.sigma_old and abs(one.old - value) < 5 * np.hypot(one.sigma_old, one.sigma)


@pytest.mark.slow
def test_kept_cameras_stay_beside_the_reference_where_that_has_not_moved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """cam1 is the reference and not the first by name; cam2 has moved, and nothing is lost."""
    old = moved(deployed(), "cam2", turn_deg=1.0)
    at_cam1 = seen_from(stated_of(old), "cam1")
    fourth = replace(old.cameras[2], name="cam3")
    placed = (*at_cam1.estimate.cam_from_rig, at_cam1.estimate.cam_from_rig[0])
    rig = replace(
        old, cameras=(*old.cameras, fourth), cam_from_rig=placed, covariance=at_cam1.covariance
    )
    assert reference_of(rig) == "cam1"
    already_mapped(monkeypatch)
    calibration = recalibrated(rig, tmp_path).outcome.calibration
    assert calibration.recalibration and calibration.recalibration.drift
    assert calibration.recalibration.drift.moved == (("cam2",),)
    kept = calibration.cam_from_rig("cam3").translation
    np.testing.assert_array_equal(kept, placed[3].translation)


# ---- lengths ---------------------------------------------------------------------------------


def test_metres_of_the_old_calibration_are_called_its_own() -> None:
    scale = result("weak").rig.scale
    assert scale.source.startswith("baseline cam1 to cam2 of the old calibration")
    assert [one.what for one in scale.ledger] == ["baseline cam1 to cam2 of the old calibration"]
    assert found("weak").drift.scale_free


def test_a_scan_with_metres_of_its_own_judges_the_size() -> None:
    drift = found("measured").drift
    assert drift.verdict == "keep" and not drift.scale_free and drift.notes == ()
    assert "old" not in result("measured").rig.scale.source
    assert found("too large").drift.verdict == "replace"


def test_an_old_calibration_without_metres_is_no_drift_of_the_size() -> None:
    drift = found("no metres").drift
    assert drift.verdict == "keep" and drift.scale_free and result("no metres").rig.metric
    assert drift.notes == ("the two have no metric scale in common: the rig's size is not judged",)


@pytest.mark.slow
def test_contributions_without_metres_are_in_one_unit() -> None:
    calibration = result("no metres anywhere")
    record = calibration.recalibration
    assert record and not calibration.rig.metric
    for name, one in record.contributions.items():
        assert one.sigma_old is not None
        assert abs(one.old - one.result) < 5 * np.hypot(one.sigma_old, one.sigma) + 1e-9, name
    assert "cam2.translation_x" in record.contributions


@pytest.mark.slow
def test_metres_by_a_distance_that_changed_are_doubted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = moved(deployed().only(["cam0", "cam1"]), "cam1", turn_deg=1.0)
    already_mapped(monkeypatch)
    done = recalibrated(old, tmp_path, scan_at=pictures(("cam0", "cam1")))
    assert done.drift.verdict == "replace" and done.outcome.calibration.verdict
    assert any("metres are by the old distance of cam0 and cam1" in one
               for one in done.outcome.calibration.verdict.messages)  # fmt: skip


# ---- what a file states ----------------------------------------------------------------------


def test_assumed_sigmas_are_said_to_be() -> None:
    drift = found("no sigmas").drift
    assert drift.old_sigma_px == 0.2
    assert any("states no sigmas" in note and "0.2 px" in note for note in drift.notes)
    assert "the old calibration states no sigmas" in said("no sigmas")


@pytest.mark.slow
def test_assumed_sigmas_are_in_a_cameras_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file whose rig frame is none of its cameras' is the same rig."""
    old = replace(deployed(), covariance=NOTHING)
    frame = Transform.exp(np.array([0.3, -0.2, 0.1]), np.array([1.0, 2.0, 3.0]))
    assert old.cam_from_rig
    elsewhere = replace(old, cam_from_rig=tuple(t @ frame for t in old.cam_from_rig))
    already_mapped(monkeypatch)
    records = []
    for rig in (old, elsewhere):
        monkeypatch.setattr(story, "calibration_sha256", lambda path: "0" * 64)
        done = story.recalibrate(
            rig, pictures(), story.RigConfig(), story.RecalibrateOptions(free=("cam2",)),
            story.DriftOptions(), story.Cache(tmp_path), lambda *_: None,
        )  # fmt: skip
        record = done.outcome.calibration.recalibration
        assert record
        records.append(record.contributions)
    for name, one in records[0].items():
        assert one.sigma_old == pytest.approx(records[1][name].sigma_old, rel=1e-6), name


@pytest.mark.slow
def test_what_rig_yaml_says_goes_before_the_old_calibration_and_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    already_mapped(monkeypatch)
    config = {"cameras": {"cam1": {"params": {"k1": -0.14}, "sigma": {"k1": 1e-5}}}}
    scan = pictures(("cam0", "cam1"))
    calibration = recalibrated(deployed(), tmp_path, scan, config=config).outcome.calibration
    assert calibration.cameras["cam1"].params["k1"] == pytest.approx(-0.14, abs=5e-4)
    assert calibration.verdict
    assert any("cam1: k1 as rig.yaml has it" in one for one in calibration.verdict.messages)


@pytest.mark.parametrize(
    ("change", "config", "why"),
    [
        ({}, {"lens": "brown"}, "^--lens brown: .* has cam0 in the lens radial"),
        ({}, {"cameras": {"cam1": {"lens": "brown"}}}, "rig.yaml gives cam1 the lens brown"),
        ({"size": (320, 240)}, {}, r"images of 640 x 480 px, and .* 320 x 240 px"),
        ({"name": "left"}, {"reference": "cam0"}, r"--reference cam0: .* has no such camera"),
    ],
)
def test_what_contradicts_the_old_calibration_is_refused(
    change: dict[str, object], config: dict[str, object], why: str, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    already_mapped(monkeypatch)
    old = deployed()
    first = replace(old.cameras[0], **change)  # type: ignore[arg-type]
    rig = replace(old, cameras=(first, *old.cameras[1:]), covariance=NOTHING)
    with pytest.raises(CalibrationError, match=why) as error:
        recalibrated(rig, tmp_path, config=config)
    assert "\n" not in str(error.value)


def test_a_camera_of_neither_size_nor_images_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    already_mapped(monkeypatch)
    old = deployed()
    rig = replace(old, cameras=tuple(replace(c, size=NO_SIZE) for c in old.cameras))
    with pytest.raises(CalibrationError, match="how large the images of cam2 are"):
        story.old_calibration(rig, scan_of(("cam0", "cam1")), (), story.DriftOptions())


def scan_of(names: tuple[str, ...]) -> story.Scan:  # type: ignore[name-defined]
    from sfm_calib.images import read_scan

    return read_scan(pictures(names), story.Cache(Path(mkdtemp())), "stem", 80, lambda *_: None)


# ---- cameras called otherwise ----------------------------------------------------------------


def old_of(names: tuple[str, ...], *cameras: str) -> story.OldCalibration:
    return story.old_calibration(deployed(), scan_of(names), cameras, story.DriftOptions())


def test_cameras_are_matched_as_told_or_by_order() -> None:
    by_order = old_of(("a", "b", "c"))
    assert by_order.rig.names == ("a", "b", "c")
    assert "matched by their order, cam0 = a, cam1 = b, cam2 = c" in by_order.notes[-1]
    told = old_of(("a", "cam1"), "cam2=a")
    assert told.rig.names == ("cam0", "cam1", "a") and not told.notes
    assert set(pose_names("a")) <= set(told.rig.covariance.names)


@pytest.mark.parametrize(
    ("names", "cameras", "why"),
    [
        (("a", "b"), (), r"none is in both; say which are the same: --cameras cam0=a"),
        (("a", "b"), ("cam0",), "--cameras cam0: say NAME"),
        (("a", "b"), ("cam0=q",), "the scan has no camera 'q'"),
        (("a", "b"), ("q=a",), "calibration has no camera 'q'|has no camera 'q'"),
        (
            ("cam0", "cam1"),
            ("cam0=cam1",),
            "two cameras of OLD are cam1 of the scan, cam0 and cam1: say",
        ),
    ],
)
def test_names_that_do_not_match_are_refused(
    names: tuple[str, ...], cameras: tuple[str, ...], why: str
) -> None:
    with pytest.raises(CalibrationError, match=why) as error:
        old_of(names, *cameras)
    assert "\n" not in str(error.value)


# ---- the command -----------------------------------------------------------------------------


def run(*arguments: object) -> int:
    return main(["recalibrate", *map(str, arguments)])


def test_two_runs_print_and_write_the_same_and_name_what_they_replace(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of a scan that lacks a camera, which the truth has."""
    already_mapped(monkeypatch)
    old, scan = written(deployed(), tmp_path / "old"), pictures(("cam0", "cam1"))
    truth = written(replace(deployed(), covariance=NOTHING), tmp_path / "truth")
    seen = []
    for out in (tmp_path / "one", tmp_path / "two"):
        given = [old, scan, "-o", out, "--json", "--exit-code"]
        assert run(*given, "--truth", truth / "calibration.json") == 0
        content = json.loads(capsys.readouterr().out)
        assert content == json.loads((out / "calibration.json").read_text())
        assert content["recalibration"]["drift"]["verdict"] == "keep"
        for record in (content["provenance"]["replaces"], content["recalibration"]["old"]):
            assert record["sha256"] == calibration_sha256(old)
            assert record["path"] == str(old / "calibration.json")
        del content["provenance"]["created"], content["provenance"]["command"]
        del content["solve"]["seconds"]
        seen.append(content)
        page = (out / "report.html").read_text()
        assert "not in the scan: kept as the old calibration has it" in page
    assert seen[0] == seen[1]


def test_the_verdict_is_the_exit_status_where_that_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    already_mapped(monkeypatch)
    old = written(moved(deployed(), "cam1", turn_deg=1.0), tmp_path / "old")
    scan = pictures(("cam0", "cam1"))
    assert run(old, scan, "-o", tmp_path / "out", "--exit-code") == 3
    printed = capsys.readouterr().out
    assert "verdict: Replace: cam1" in printed
    assert "cam2: radial, 640 x 480 px, not in the scan: kept" in printed
    unsure = ["--exit-code", "--matters-px", "0.01"]
    assert run(old, pictures(("cam2",)), "-o", tmp_path / "out", *unsure) == 4
    capsys.readouterr()
    assert run(old, scan, "-o", tmp_path / "out", "--free", "cam9") == 2
    assert run(tmp_path / "gone", scan, "-o", tmp_path / "out") == 2
    assert run(old, scan, "-o", tmp_path / "out", "--free") == 2
    errors = capsys.readouterr().err
    assert "Traceback" not in errors and "did you mean 'cam" in errors


def test_an_old_calibration_is_replaced_only_where_that_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    already_mapped(monkeypatch)
    old, scan = written(deployed(), tmp_path / "old"), pictures(("cam1",))
    content, was = (old / "calibration.json").read_bytes(), calibration_sha256(old)
    assert run(old, scan, "-o", old) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert sorted(p.name for p in old.iterdir()) == ["calibration.json"]

    def broken(*_: object) -> None:
        raise CalibrationError("no optimum")

    with monkeypatch.context() as failing:
        failing.setattr(story, "solve_problem", broken)
        assert run(old, scan, "-o", old, "--overwrite") == 2
        assert run(old, scan, "-o", tmp_path / "out") == 2
    assert (old / "calibration.json").read_bytes() == content
    assert not (old / "report.html").exists() and not list((tmp_path / "out").glob("*.*"))

    assert run(old, scan, "-o", old, "--overwrite") == 0
    new = load_calibration(old / "calibration.json")
    assert new.provenance.replaces and new.provenance.replaces.sha256 == was
    assert calibration_sha256(old) != was


def test_a_truth_of_other_cameras_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    old = written(deployed(), tmp_path / "old")
    truth = written(deployed().only(["cam0"]), tmp_path / "truth") / "calibration.json"
    scan = pictures(("cam0", "cam1"))
    assert run(old, scan, "-o", tmp_path / "out", "--truth", truth) == 2
    assert "the truth is of" in capsys.readouterr().err
