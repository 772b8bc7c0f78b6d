"""Every format into every other and back, real files too; what is refused, and what is told."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from synthetic.calibrations import READ_BACK, apart_px, rig_of, there
from synthetic.scans import DATA

from graphs.covariance import Covariance
from graphs.lenses import LENS_NAMES, LensName
from sfm_calib.errors import CalibrationError
from sfm_calib.formats import NO_SIZE, CameraRig, read_calibration
from sfm_calib.formats.convert import (
    FORMATS,
    MOST_ERROR_PX,
    FormatName,
    exported,
    format_of,
    lens_error,
)
from sfm_calib.formats.writing import Export

EXACT_PX = 1e-6
DIFFERENT = [name for name in READ_BACK if name not in ("opencv_xml", "opencv_json")]  # in lenses
REAL = (
    "fisheye_rig5/kalibr/calib_3_cam0-1-camchain-imucam.yaml",
    "fisheye_rig5/kalibr/calib_3_cam2-camchain-imucam.yaml",
    "opencv_stereo/left_intrinsics.yml",
    "charuco_rig4/camera_array.toml",
    "mocap_static4/Calib.qca.txt",
    "street_stereo/calib.txt",
)


def holding(*counts: str) -> list[FormatName]:
    return [name for name in READ_BACK if FORMATS[name].cameras in counts]


def refusal(rig: CameraRig, to: FormatName, max_error_px: float = MOST_ERROR_PX) -> str:
    with pytest.raises(CalibrationError) as caught:
        exported(rig, to, max_error_px)
    message = str(caught.value)
    assert "\n" not in message
    return message


def export_or_none(rig: CameraRig, to: FormatName, max_error_px: float) -> Export | None:
    try:
        return exported(rig, to, max_error_px)
    except CalibrationError:
        return None


# ---- there and back ------------------------------------------------------------------------


@pytest.mark.parametrize(("a", "b"), [*product(holding("any"), repeat=2)])
def test_three_cameras_go_everywhere_and_come_back(
    a: FormatName, b: FormatName, tmp_path: Path
) -> None:
    """The demo's rig: three cameras in metres, radtan, which every format holds."""
    made = rig_of("radtan", "radtan", "radtan")
    first = there(made, a, tmp_path / "1")
    back = there(there(first, b, tmp_path / "2"), a, tmp_path / "3")
    assert apart_px(made, first) < EXACT_PX
    assert apart_px(made, back) < EXACT_PX
    assert back.unit == "m"


@pytest.mark.parametrize("lens", ["radtan", pytest.param("kannala_brandt", marks=pytest.mark.slow)])
@pytest.mark.parametrize(("a", "b"), [*product(holding("two", "any"), repeat=2)])
def test_a_pair_goes_everywhere_and_comes_back(
    a: FormatName, b: FormatName, lens: LensName, tmp_path: Path
) -> None:
    held = {lens, "brown"} if lens == "radtan" else {lens}
    if not all(held & set(FORMATS[name].lenses) for name in (a, b)):
        pytest.skip(f"no {lens} in {a} or {b}")
    made = rig_of(lens, lens, names=("left", "right"))
    first = there(made, a, tmp_path / "1")
    back = there(there(first, b, tmp_path / "2"), a, tmp_path / "3")
    assert apart_px(made, back) < EXACT_PX
    assert back.unit == "m"


@pytest.mark.parametrize(("to", "lens"), [*product(DIFFERENT, LENS_NAMES)])
def test_every_lens_is_held_refitted_or_refused(
    to: FormatName, lens: LensName, tmp_path: Path
) -> None:
    rig = rig_of(lens)
    if (export := export_or_none(rig, to, MOST_ERROR_PX)) is None:
        assert f"no {lens} lens" in refusal(rig, to) and lens not in FORMATS[to].lenses
        return
    back = there(rig, to, tmp_path / "x", MOST_ERROR_PX)
    off = lens_error(rig.cameras[0], back.cameras[0])[1]
    refitted = [note for note in export.notes if "refitted" in note]
    assert off < (MOST_ERROR_PX if refitted else EXACT_PX)
    if refitted:
        stated = float(refitted[0].rpartition(" and ")[2].split()[0])
        assert off == pytest.approx(stated, rel=0.06)  # two digits


@pytest.mark.slow
@pytest.mark.parametrize("name", REAL)
@pytest.mark.parametrize("to", DIFFERENT)
def test_real_files_go_everywhere(to: FormatName, name: str, tmp_path: Path) -> None:
    if not (DATA / name).exists():
        pytest.skip(f"../shared/data/{name} is not on this machine")
    rig = read_calibration(DATA / name)
    sized = tuple(replace(c, size=(1241, 376)) if c.size == NO_SIZE else c for c in rig.cameras)
    rig = replace(rig, cameras=sized).only(rig.names[:2])
    if (export := export_or_none(rig, to, 20.0)) is None:
        assert "choose another format" in refusal(rig, to, 20.0)  # a fisheye as a pinhole
        return
    back = there(rig, to, tmp_path / "x", 20.0)
    told = "\n".join(export.notes)
    for one, other in zip(rig.cameras, back.only(rig.names).cameras, strict=True):
        off = lens_error(one, other)[1]
        assert off < (20.0 if f"{one.name}: {one.lens} is refitted" in told else EXACT_PX)
    again = there(back, to, tmp_path / "y")
    assert apart_px(back, again) < EXACT_PX
    held = replace(rig, cameras=back.only(rig.names).cameras)
    assert back.cam_from_rig is None or apart_px(held, back.only(rig.names)) < EXACT_PX


# ---- lenses --------------------------------------------------------------------------------


def test_coefficients_that_are_zero_may_go(tmp_path: Path) -> None:
    brown = rig_of("brown")
    params = brown.cameras[0].params.copy()
    params[-1] = 0.0  # k3
    plain = replace(brown, cameras=(replace(brown.cameras[0], params=params),))
    assert there(plain, "kalibr", tmp_path / "a").cameras[0].lens == "radtan"
    assert "which is the same" in exported(plain, "kalibr").notes[0]
    message = refusal(brown, "kalibr")
    assert "Kalibr camchain has no brown lens" in message and "its radtan is nearest" in message
    assert "rms" in message and "convert --max-error-px 0.1" in message
    assert "refitted as radtan, off by" in exported(brown, "kalibr", 5.0).notes[0]


def test_a_fisheye_that_no_pinhole_sees_is_refused() -> None:
    rig = rig_of("kannala_brandt")
    params = rig.cameras[0].params.copy()
    params[:2] = 150.0
    wide = replace(rig, cameras=(replace(rig.cameras[0], params=params),))
    only_pinholes = replace(FORMATS["ros"], lenses=("brown",))
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(FORMATS, "ros", only_pinholes)
        assert "sees nothing" in refusal(wide, "ros", 100.0)


# ---- what cannot be held is told -----------------------------------------------------------


def with_sigmas(rig: CameraRig) -> CameraRig:
    names = ("cam0.fx", "cam0.cx", "cam1.fx", "cam1.rotation_x", "cam1.translation_y")
    root = np.random.default_rng(0).normal(size=(5, 5))
    return replace(rig, covariance=Covariance(names, root @ root.T))


@pytest.mark.parametrize("to", [name for name in READ_BACK if name != "sfm_calib"])
def test_sigmas_are_not_dropped_in_silence(to: FormatName) -> None:
    if FORMATS[to].cameras == "one":
        pytest.skip("one camera")
    assert any("sigma" in n for n in exported(with_sigmas(rig_of("radtan", "radtan")), to).notes)
    assert not any("sigma" in n for n in exported(rig_of("radtan", "radtan"), to).notes)


def test_our_own_keeps_covariance_and_sigmas(tmp_path: Path) -> None:
    rig = with_sigmas(rig_of("brown", "brown"))
    back = there(rig, "sfm_calib", tmp_path / "calibration.json")
    assert back.covariance.names == rig.covariance.names
    assert back.covariance.matrix == pytest.approx(rig.covariance.matrix, rel=1e-15)
    told = rig.calibration()
    assert told.cameras["cam0"].sigma["fx"] == rig.covariance.sigma["cam0.fx"]
    assert told.cameras["cam0"].sigma["k1"] == 0.0
    assert np.radians(told.rig.cam_from_rig["cam1"].sigma_rotation_deg[0]) == pytest.approx(
        rig.covariance.sigma["cam1.rotation_x"]
    )
    assert told.rig.cam_from_rig["cam1"].sigma_translation[1] > 0


def test_without_its_reference_a_rig_is_seen_from_the_first(tmp_path: Path) -> None:
    """Its covariance goes along: how cam2 sits from cam1 is known as well as before."""
    rig = rig_of("radtan", "radtan", "radtan")
    names = tuple(f"cam{i}.translation_x" for i in (1, 2))
    rig = replace(rig, covariance=Covariance(names, np.array([[4e-6, 3e-6], [3e-6, 4e-6]])))
    back = there(rig.only(["cam1", "cam2"]), "sfm_calib", tmp_path / "calibration.json")
    assert back.cam_from_rig is not None
    assert back.cam_from_rig[0].translation == pytest.approx(0)
    variance = back.covariance.sigma["cam2.translation_x"] ** 2
    assert variance == pytest.approx(4e-6 + 4e-6 - 2 * 3e-6, rel=0.01)
    assert apart_px(rig.only(["cam1", "cam2"]), back) < EXACT_PX


@pytest.mark.parametrize("unit", ["baseline", "unknown"])
def test_metres_are_never_made_up(unit: str, tmp_path: Path) -> None:
    rig = replace(rig_of("radtan", "radtan"), unit=unit)  # type: ignore[arg-type]
    for to in ("kalibr", "ros"):
        assert "--metres" in refusal(rig, to)  # type: ignore[arg-type]
        exported(rig.only(["cam0"]), to)  # type: ignore[arg-type]
    back = there(rig.metric(0.5), "kalibr", tmp_path / "a")
    assert back.cam_from_rig is not None and rig.cam_from_rig is not None
    assert back.cam_from_rig[1].translation == pytest.approx(0.5 * rig.cam_from_rig[1].translation)
    assert there(rig, "opencv", tmp_path / "b").unit == unit
    assert not there(rig, "sfm_calib", tmp_path / "c").calibration().rig.metric


def test_cameras_without_places() -> None:
    rig = replace(rig_of("radtan", "radtan"), cam_from_rig=None)
    assert "does not say how its 2 cameras sit" in refusal(rig, "kalibr")
    assert "--camera cam0" in refusal(rig, "opencv")
    assert len(exported(rig, "ros").files) == 2
    assert exported(rig.only(["cam1"]), "kalibr").files
    three = exported(rig_of("radtan", "radtan", "radtan"), "ros")
    assert len(three.files) == 3 and any("holds no places" in note for note in three.notes)


def test_sizes_that_are_not_known() -> None:
    rig = rig_of("radtan")
    rig = replace(rig, cameras=(replace(rig.cameras[0], size=NO_SIZE),))
    assert "--size" in refusal(rig, "opencv")


def test_the_name_tells_the_format() -> None:
    assert format_of(Path("a/left-camchain.yaml"), None) == "kalibr"
    assert format_of(Path("calibration.json"), None) == "sfm_calib"
    assert format_of(Path("x.XML"), None) == "opencv_xml"
    assert format_of(Path("x.json"), "opencv") == "opencv_json"
    assert format_of(Path("x.json"), "sfm_calib") == "sfm_calib"
    with pytest.raises(CalibrationError, match=r"say --to .*kalibr.*opencv"):
        format_of(Path("x.yaml"), None)
