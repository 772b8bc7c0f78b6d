"""The story of a recalibration, from a scan that is mapped already."""

from __future__ import annotations

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
    larger,
    mapped,
    measured_m,
    moved,
    pictures,
    recalibrated,
)

from graphs.frames import log_rotation
from graphs.propagation import lens_names, marginal, pose_names
from sfm_calib import recalibrate as story
from sfm_calib.errors import CalibrationError
from sfm_calib.formats import read_calibration
from sfm_calib.formats.reading import CameraRig
from sfm_calib.partial import reference_of, seen_from
from sfm_calib.recalibrate import Recalibrated
from sfm_calib.result import Calibration

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
    }
    rig, options = cases[case]
    with pytest.MonkeyPatch.context() as patch:
        already_mapped(patch)
        return recalibrated(rig, Path(mkdtemp()), **options)  # type: ignore[arg-type]


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
    names = {n for c in calibration.cameras for n in lens_names(calibration.camera(c))}
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
    weak, full = (result(mode).noise for mode in ("weak", "full"))
    assert weak and full
    lenses = [f"{c.name}.{p}" for c in deployed().cameras for p in c.names]
    assert all(full.sigmas[n].model < 0.99 * weak.sigmas[n].model for n in lenses)


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
    old = seen_from(deployed().stated, "cam1")
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


@pytest.mark.slow
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
    at_cam1 = seen_from(old.stated, "cam1")
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


@pytest.mark.slow
def test_a_scan_with_metres_of_its_own_judges_the_size() -> None:
    drift = found("measured").drift
    assert drift.verdict == "keep" and not drift.scale_free and drift.notes == ()
    assert "old" not in result("measured").rig.scale.source
    assert found("too large").drift.verdict == "replace"


def test_an_old_calibration_without_metres_is_no_drift_of_the_size() -> None:
    drift = found("no metres").drift
    assert drift.verdict == "keep" and drift.scale_free and result("no metres").rig.metric
    assert "states no unit of length (--metres" in drift.notes[0]
    assert drift.notes[1:] == (
        "the two have no metric scale in common: the rig's size is not judged",
    )


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
