"""calibration.json: written whole, read strictly."""

import json
from datetime import datetime, timedelta, timezone

import numpy as np
import pytest

from graphs.camera import Camera
from graphs.frames import Transform
from sfm_calib.errors import CalibrationError
from sfm_calib.provenance import Provenance, Replaced
from sfm_calib.recalibration_record import Contribution, OldFile, Recalibration
from sfm_calib.result import (
    Calibration,
    LensChoice,
    Noise,
    NoiseBySize,
    Rung,
    Sigmas,
    Split,
    Verdict,
    WeakDirection,
    load_calibration,
    save_calibration,
    truth,
)


def rig(names=("left", "right")):
    params = np.array([500.0, 501.0, 320.0, 240.0, -0.1, 0.01, 0.0, 0.0])
    cameras = [Camera(name, "radtan", (640, 480), params) for name in names]
    turns = [[1.0, 0.0, 0.0, 0.0], [np.cos(0.1), 0.0, np.sin(0.1), 0.0]][: len(names)]
    moves = [[0.0, 0.0, 0.0], [-0.2, 0.0, 0.01]][: len(names)]
    transforms = [Transform.from_wxyz(q, t) for q, t in zip(turns, moves, strict=True)]
    return truth(cameras, transforms, "0.0")


def test_what_is_saved_is_read_again(tmp_path):
    save_calibration(rig(), tmp_path / "new" / "calibration.json")
    read = load_calibration(tmp_path / "new" / "calibration.json")
    assert read == rig() and read.camera("right").named()["k1"] == -0.1
    expected = Transform.from_wxyz([np.cos(0.1), 0.0, np.sin(0.1), 0.0], [-0.2, 0.0, 0.01])
    np.testing.assert_allclose(read.cam_from_rig("right").rotation, expected.rotation)
    assert (
        json.loads((tmp_path / "new" / "calibration.json").read_text())["format"] == "sfm_calib/1"
    )


def test_what_the_sigmas_rest_on_is_read_again(tmp_path):
    size = NoiseBySize(smallest_px=None, largest_px=None, n_observations=9, sigma_px=0.3)
    rung = Rung(
        lens="brown", held=("p1",), held_out_px=None, against=0, gain_px=0.0, gain_sigmas=0.0,
        shift_focal_px=0.0, shift_centre_px=0.0, sigma={"left.fx": 1.0}, weak=(), verdict="",
    )  # fmt: skip
    sigmas = {"left.fx": Sigmas(model=0.1, robust=0.2, stated=0.3)}
    split = Split(difference_px=1.0, expected_px=2.0, p_value=0.5, agrees=True)
    whole = rig().model_copy(
        update={
            "noise": Noise(sigma_px=0.3, sigmas=sigmas, by_size={"left": (size,)}),
            "lens_choice": LensChoice(
                chosen=0, reason="", n_frames=0, n_observations=0, rungs=(rung,)
            ),
            "verdict": Verdict(usable=True, split=split),
        }
    )
    save_calibration(whole, tmp_path / "calibration.json")
    assert load_calibration(tmp_path / "calibration.json") == whole


def test_how_far_a_weak_direction_goes_is_said():
    weak = WeakDirection(what="cx", effect_px=1.34, remedy="")
    assert weak.sizes == "up to 1.3 px in the image"
    assert weak.model_copy(update={"effect_px": None}).sizes == ""
    sizes = {"slide_px": 4.5, "effect_centre_px": 0.113, "effect_corner_px": 0.87}
    free = "free by 4.5 px, which shows as 0.11 px at the centre and 0.87 px in a corner"
    assert weak.model_copy(update=sizes | {"prior_share": 0.4}).sizes == free
    believed = weak.model_copy(update=sizes | {"prior_share": 0.9})
    assert believed.sizes == f"{free}; 90% of what is known comes from priors"


def set_in(content, path, value):
    *parents, last = path.split(".")
    for key in parents:
        content = content[key]
    if value is None:
        del content[last]
    else:
        content[last] = value


WRONG = {
    "another format": ("format", "sfm_calib/2", "format: "),
    "no cameras": ("cameras", None, "cameras: Field required"),
    "an unknown key": ("rig.colour", "red", "rig.colour: Extra inputs are not permitted"),
    "an unknown lens": ("cameras.left.lens", "magic", "cameras.left.lens: "),
    "a missing parameter": ("cameras.left.params.k2", None, "a radtan lens has the parameters fx"),
    "a parameter too many": ("cameras.left.params.k9", 0.0, "a radtan lens has the parameters fx"),
    "a word for a number": ("cameras.left.params.fx", "long", "cameras.left.params.fx: "),
    "an unknown reference": ("rig.reference", "top", "'top' is none of the cameras"),
    "a camera off the rig": ("rig.cam_from_rig.right", None, "must name the same cameras"),
    "a covariance of another size": ("covariance.names", ["left.fx"], "1 names need a matrix of 1"),
}


@pytest.mark.parametrize(("key", "value", "message"), WRONG.values(), ids=WRONG)
def test_what_is_wrong_is_named(tmp_path, key, value, message):
    content = json.loads(rig().model_dump_json())
    set_in(content, key, value)
    (tmp_path / "c.json").write_text(json.dumps(content))
    with pytest.raises(CalibrationError) as caught:
        load_calibration(tmp_path / "c.json")
    assert message in str(caught.value) and "is no sfm_calib/1 file" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[]", b"null"])
def test_files_of_another_kind(tmp_path, content):
    (tmp_path / "c.json").write_bytes(content)
    with pytest.raises(CalibrationError, match=r"is not JSON|is no sfm_calib/1 file"):
        load_calibration(tmp_path / "c.json")


def test_no_file(tmp_path):
    with pytest.raises(CalibrationError, match=r"cannot read .*: No such file"):
        load_calibration(tmp_path / "c.json")


def test_what_is_not_a_number_is_not_written():
    with pytest.raises(ValueError, match="finite number"):
        Calibration.model_validate(
            rig().model_dump() | {"noise": {"sigma_px": float("nan"), "inflation": 1.0}}
        )


# ---- of a recalibration --------------------------------------------------------------------

HASH = "0" * 63 + "f"
OLD = OldFile(path="old.yaml", sha256=HASH, format="Kalibr")


def recalibrated():
    known = Contribution(old=500.0, sigma_old=None, result=501.0, sigma=0.1, prior_share=0.2)
    record = Recalibration(
        old=OLD, prior="weak", freed=("intrinsics of left",), kept=("right",),
        contributions={"left.fx": known},
    )  # fmt: skip
    right = rig().cameras["right"].model_copy(update={"kept_from": HASH})
    provenance = Provenance(
        version="1",
        created=datetime(2026, 5, 4, 3, 2, 1, 999, timezone(timedelta(hours=2))),
        replaces=Replaced(path="old.yaml", sha256=HASH),
    )
    cameras = rig().cameras | {"right": right}
    update = {"cameras": cameras, "recalibration": record, "provenance": provenance}
    return Calibration.model_validate((rig().model_copy(update=update)).model_dump())


def test_what_became_of_an_old_calibration_is_read_again(tmp_path):
    save_calibration(recalibrated(), tmp_path / "c.json")
    assert load_calibration(tmp_path / "c.json") == recalibrated()
    written = json.loads((tmp_path / "c.json").read_text())
    assert written["provenance"]["created"] == "2026-05-04T01:02:01Z"


def test_files_from_before_recalibrations_are_read(tmp_path):
    content = json.loads(rig().model_dump_json())
    del content["recalibration"], content["provenance"]["created"]
    del content["provenance"]["replaces"], content["cameras"]["left"]["kept_from"]
    (tmp_path / "c.json").write_text(json.dumps(content))
    assert load_calibration(tmp_path / "c.json") == rig()


WRONG_RECORDS = {
    "another prior": ("recalibration.prior", "strong", "recalibration.prior: "),
    "no hash": ("recalibration.old.sha256", "f00", "recalibration.old.sha256: "),
    "an unknown key": ("recalibration.why", "", "recalibration.why: Extra inputs"),
    "no mark": ("cameras.right.kept_from", "", "must name the cameras that have a kept_from"),
    "kept and added": ("recalibration.added", ["right"], "right cannot be both kept and added"),
    "a moment of no zone": ("provenance.created", "2026-05-04T01:02:01", "provenance.created: "),
}


@pytest.mark.parametrize(("key", "value", "message"), WRONG_RECORDS.values(), ids=WRONG_RECORDS)
def test_what_is_wrong_with_a_recalibration_is_named(tmp_path, key, value, message):
    content = json.loads(recalibrated().model_dump_json())
    set_in(content, key, value)
    (tmp_path / "c.json").write_text(json.dumps(content))
    with pytest.raises(CalibrationError) as caught:
        load_calibration(tmp_path / "c.json")
    assert message in str(caught.value)
