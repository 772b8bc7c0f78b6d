"""Verdicts on made pairs, matching of cameras and units, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from synthetic.cameras import camera_of

from graphs.camera import Camera, fit_lens
from graphs.covariance import NOTHING, Covariance
from graphs.frames import Transform
from graphs.pose_covariance import rereferenced
from graphs.problem import Estimate
from graphs.propagation import lens_names, pose_names
from sfm_calib.compare import Compared, CompareOptions, compare, compare_files
from sfm_calib.compare_command import Compare, run_compare
from sfm_calib.compare_record import Comparison
from sfm_calib.compare_terminal import print_compared
from sfm_calib.errors import CalibrationError
from sfm_calib.formats import NO_SIZE, CameraRig, LengthUnit
from sfm_calib.report.comparison import render_comparison

LENS = replace(camera_of("radtan"), name="left")
RIGHT = Transform.exp(np.array([0.01, 0.05, -0.02]), np.array([-0.3, 0.0, 0.0]))


def made(
    cameras: tuple[Camera, ...] = (LENS, replace(LENS, name="right")),
    rig: tuple[Transform, ...] | None = (Transform.identity(), RIGHT),
    unit: LengthUnit = "m",
    sigma_px: float = 0.0,
    name: str = "made",
) -> CameraRig:
    """Independent sigmas: sigma_px in the picture from each parameter, more or less."""
    covariance = NOTHING
    if sigma_px:
        names: list[str] = []
        sigmas: list[float] = []
        for camera in cameras:
            names += lens_names(camera)
            sigmas += [sigma_px] * 4 + [sigma_px * 4e-3] * (len(camera.names) - 4)
        for camera in cameras[1:] if rig else ():
            names += pose_names(camera.name)
            sigmas += [sigma_px * 2e-3] * 3 + [sigma_px * 2e-3] * 3
        covariance = Covariance(tuple(names), np.diag(np.square(sigmas)))
    return CameraRig(Path(name), "made", cameras, rig, unit, covariance)


def single(sigma_px: float = 0.0, **moves: float) -> CameraRig:
    return made((moved(LENS, **moves),), None, "unknown", sigma_px)


def moved(camera: Camera, **moves: float) -> Camera:
    params = camera.params.copy()
    for name, move in moves.items():
        params[camera.names.index(name)] += move
    return replace(camera, params=params)


def compared(a: CameraRig, b: CameraRig, **options: object) -> Comparison:
    return compare(a, b, CompareOptions(**options)).record  # type: ignore[arg-type]


def said(record: Comparison) -> str:
    return "\n".join(record.verdict.lines)


# ---- verdicts ------------------------------------------------------------------------------


def test_a_calibration_is_the_same_as_itself() -> None:
    record = compared(made(sigma_px=0.5), made())
    assert record.verdict.kind == "same"
    assert "The two are the same" in said(record)
    assert all(row.difference == 0 for row in record.parameters)
    assert record.a.states_sigmas and not record.b.states_sigmas
    assert any("B states no sigmas" in note for note in record.notes)


def test_a_rig_of_another_reference_is_the_same() -> None:
    a = made(sigma_px=0.5)
    assert a.cam_from_rig
    estimate = Estimate(a.cameras, a.cam_from_rig, (), np.zeros((0, 3)))
    other, covariance = rereferenced(estimate, a.covariance, 1)
    b = replace(a, cam_from_rig=other.cam_from_rig, covariance=covariance)
    record = compared(a, b)
    assert record.verdict.kind == "same"
    assert record.taken_out[0].rotation_deg[1] != 0
    for row in record.parameters:  # and its sigmas are the same
        assert row.sigma_b == pytest.approx(row.sigma_a, rel=1e-9), row.name


def test_what_noise_explains_agrees() -> None:
    record = compared(single(0.5), single(0.5, fx=0.4, fy=0.5, k1=1e-3))
    assert record.verdict.kind == "agree"
    assert "nothing differs by more than noise explains (p = " in said(record)
    assert record.chance and record.chance.p_value > 0.05


def test_what_noise_does_not_explain_differs() -> None:
    record = compared(single(0.2), single(0.2, fx=8.0, fy=8.0))
    assert record.verdict.kind == "differ"
    assert "They differ: f" in said(record)
    assert "of left by 8.0 px (28.3 combined sigmas)" in said(record)  # 8 / (0.2 sqrt 2)
    assert record.chance and record.chance.p_value < 1e-4


def test_a_principal_point_that_a_rotation_hides() -> None:
    record = compared(single(0.2), single(0.2, cx=23.0))
    hidden = next(line for line in record.verdict.lines if "principal point" in line)
    left = record.projection["left"][0].rms_px
    assert left < 6
    assert hidden == (
        f"the principal point of left is 23 px off, but a rotation hides all but {left:.1f} px "
        "(rms) of it"
    )


def test_large_sigmas_cannot_tell() -> None:
    record = compared(single(6.0), single(fx=5.0, fy=5.0))
    assert record.verdict.kind == "cannot tell"
    assert said(record).startswith("A cannot tell: they lie")
    turned = compared(single(fx=5.0, fy=5.0), single(6.0))
    assert said(turned).startswith("B cannot tell")
    both = compared(single(6.0, fx=5.0, fy=5.0), single(6.0))
    assert said(both).startswith("Neither can tell")


def test_absurd_sigmas_cannot_tell_either() -> None:
    record = compared(single(500.0), single(fx=5.0))
    assert record.verdict.kind == "cannot tell"
    assert "so large" in said(record)


def test_without_sigmas_no_chance_is_told() -> None:
    record = compared(single(), single(fx=5.0))
    assert record.verdict.kind == "no sigmas" and record.chance is None
    assert "neither states sigmas" in said(record)
    assert all(row.z is None for row in record.parameters)


def test_what_was_held_is_no_agreement() -> None:
    a = single(0.5)
    kept = [i for i, n in enumerate(a.covariance.names) if n.rpartition(".")[2][0] in "fc"]
    held = Covariance(
        tuple(a.covariance.names[i] for i in kept), a.covariance.matrix[np.ix_(kept, kept)]
    )
    record = compared(replace(a, covariance=held), single(k2=0.08))
    assert record.verdict.kind == "differ"
    assert "no sigma reaches" in said(record) or (record.chance and record.chance.p_value < 0.01)


def test_a_longer_baseline_is_longer_depths() -> None:
    longer = (Transform.identity(), replace(RIGHT, translation=1.01 * RIGHT.translation))
    record = compared(made(rig=longer, sigma_px=0.1), made(sigma_px=0.1))
    pair = record.pairs[0]
    assert pair.baseline_percent == pytest.approx(100 / 1.01 - 100)
    assert [d.median_percent for d in pair.depth] == pytest.approx([1.0] * 4, abs=1e-6)
    assert [d.range for d in pair.depth] == [1, 2, 5, 10]
    assert "+1.0 / +1.0 / +1.0 / +1.0 % at 1 / 2 / 5 / 10 m" in said(record)


# ---- lenses --------------------------------------------------------------------------------


def test_other_lenses_are_compared_by_what_they_see() -> None:
    fitted, error_px = fit_lens(moved(LENS, p1=-0.004, p2=0.007), "kannala_brandt")
    a = made((moved(LENS, p1=-0.004, p2=0.007),), None, "unknown", 0.3)
    b = made((fitted,), None, "unknown")
    record = compared(a, b)
    match = record.cameras[0]
    assert (match.lens, match.lens_b) == ("radtan", "kannala_brandt")
    assert 0 < match.fit_error_px < 1.5
    assert record.projection["left"][0].rms_px < 3 * error_px + 0.1
    assert any("B was fitted as radtan" in note for note in record.notes)
    assert {row.name for row in record.parameters} == {f"left.{n}" for n in LENS.names}


def test_a_lens_with_more_coefficients_is_like_for_like() -> None:
    brown = Camera("left", "brown", LENS.size, np.append(LENS.params, 0.01))
    record = compared(made((brown,), None, "unknown", 0.3), single(0.3))
    assert record.cameras[0].fit_error_px == 0
    row = next(row for row in record.parameters if row.name == "left.k3")
    assert (row.b, row.sigma_b) == (0.0, 0.0) and row.z is not None


# ---- cameras, sizes, units -----------------------------------------------------------------


def names(*of: str) -> tuple[Camera, ...]:
    return tuple(replace(LENS, name=name) for name in of)


def test_cameras_match_by_name_whatever_their_order() -> None:
    a = made(sigma_px=0.2)
    assert a.cam_from_rig
    b = replace(a, cameras=a.cameras[::-1], cam_from_rig=a.cam_from_rig[::-1])
    record = compared(a, b)
    assert record.verdict.kind == "same"
    assert [(m.name, m.name_b) for m in record.cameras] == [("left", "left"), ("right", "right")]


def test_cameras_match_by_order_where_names_say_nothing() -> None:
    record = compared(made(sigma_px=0.2), made(names("cam1", "cam2"), sigma_px=0.2))
    assert record.verdict.kind == "same"
    assert any("left = cam1, right = cam2" in note for note in record.notes)
    assert record.parameters[0].sigma_b > 0  # the covariance was renamed too


def test_cameras_match_as_they_are_told() -> None:
    a, b = made(), made(names("u", "v", "w"), (Transform.identity(), RIGHT, RIGHT.inverse))
    for told in (("left=u", "right=v"), ("left=u,right=v",)):
        assert compared(a, b, cameras=told).verdict.kind == "same"
    with pytest.raises(CalibrationError, match="no camera 'x'"):
        compared(a, b, cameras=("left=x",))
    with pytest.raises(CalibrationError, match="a camera twice"):
        compared(a, b, cameras=("left=u", "left=v"))
    with pytest.raises(CalibrationError, match=r"do not match.*--cameras left=u"):
        compared(a, b)


def test_cameras_that_one_lacks_are_left_out() -> None:
    record = compared(made(), single())
    assert list(record.projection) == ["left"] and record.unit is None
    assert any("B has no" in n or "no such camera: A's right" in n for n in record.notes)


def test_other_image_sizes_are_refused() -> None:
    other = replace(LENS, size=(1280, 960))
    with pytest.raises(CalibrationError, match=r"640 x 480 px in A and 1280 x 960 px in B.*scale"):
        compared(single(), made((other,), None))
    unknown = replace(LENS, size=NO_SIZE)
    assert compared(single(), made((unknown,), None)).verdict.kind == "same"
    with pytest.raises(CalibrationError, match="neither made nor made states the image size"):
        compared(made((unknown,), None), made((unknown,), None))


def test_a_rig_without_a_scale_is_compared_in_the_other_ones_metres() -> None:
    assert RIGHT is not None
    half = (Transform.identity(), RIGHT.scaled(1 / 0.3))
    record = compared(made(rig=half, unit="baseline", sigma_px=0.3), made())
    assert record.verdict.kind == "same" and record.unit == "m"
    assert record.taken_out[0].scale == pytest.approx(0.3, rel=1e-6)
    assert record.pairs[0].baseline_percent is None
    turned = compared(made(), made(rig=half, unit="baseline", sigma_px=0.3))
    assert turned.taken_out[0].scale == pytest.approx(1 / 0.3, rel=1e-6)
    neither = compared(made(rig=half, unit="baseline"), made(unit="unknown"))
    assert neither.verdict.kind == "same" and neither.unit == "baseline"
    assert [one.range for one in neither.projection["left"]] == [5, 10, 20, 50, None]


def test_cameras_without_a_rig_are_compared_alone() -> None:
    turned = Transform.exp(np.array([0.3, 0.2, 0.1]), np.ones(3))
    a = made(rig=(Transform.identity(), turned))
    record = compared(a, made(rig=None))
    assert record.verdict.kind == "same" and not record.pairs
    assert any("B does not say how its cameras sit" in note for note in record.notes)


def test_options_that_cannot_be() -> None:
    with pytest.raises(CalibrationError, match="--metres-a -1"):
        CompareOptions(metres_a=-1.0)
    with pytest.raises(CalibrationError, match="ranges are positive"):
        CompareOptions(ranges=(1.0, 0.0))


# ---- outputs -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def two() -> Compared:
    right = replace(LENS, name="right")
    cameras = (moved(LENS, fx=3.0, fy=3.0), moved(right, cx=4.0))
    return compare(made(sigma_px=0.4), made(cameras, sigma_px=0.4), CompareOptions())


def test_the_record_is_whole(two: Compared) -> None:
    text = two.record.model_dump_json()
    assert Comparison.model_validate_json(text) == two.record
    assert json.loads(text)["format"] == "sfm_calib/compare/1"


def test_the_terminal_says_it_all(two: Compared, capsys: pytest.CaptureFixture[str]) -> None:
    print_compared(two.record, Console(width=80, markup=False))
    out = capsys.readouterr().out
    for word in ("translation_x", "infinity", "left and right", "chi-square", "taken out"):
        assert word in out, word
    assert f"verdict: {two.record.verdict.lines[0]}" in out
    assert max(len(line) for line in out.splitlines() if line[:1] in "┏┃┡│├└") <= 80


def test_the_page_holds_the_numbers_and_loads_nothing(two: Compared) -> None:
    page = render_comparison(two.record, two.found)
    assert "They differ" in page and "map-1-4" in page and 'id="depth"' in page
    assert page.count("plotly-graph-div") == 2 * 5 + 2
    assert "<script src" not in page and "{{" not in page.split("<main>")[1]


def test_the_page_of_lenses_alone() -> None:
    one = compare(single(), single(fx=2.0), CompareOptions())
    page = render_comparison(one.record, one.found)
    assert "No sigmas to judge by" in page and 'id="pairs"' not in page


def test_the_command_writes_and_prints(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = "700 0 320\n0 701 240\n0 0 1\n"
    (tmp_path / "a.txt").write_text(text)
    (tmp_path / "b.txt").write_text(text.replace("701", "705"))
    a, b = tmp_path / "a.txt", tmp_path / "b.txt"
    with pytest.raises(CalibrationError, match="states the image size"):
        run_compare(Compare(a, b))
    storage = "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\ncamera_matrix: "
    matrix = "!!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [{}]\n"
    data = "700., 0., 320., 0., 701., 240., 0., 0., 1."
    (tmp_path / "c.yml").write_text(storage + matrix.format(data))
    run_compare(Compare(a, tmp_path / "c.yml", tmp_path, json=True))
    assert json.loads(capsys.readouterr().out)["verdict"]["kind"] == "same"
    assert (tmp_path / "compare.json").exists() and (tmp_path / "compare.html").exists()
    run_compare(Compare(b, tmp_path / "c.yml"))
    assert "They are" in capsys.readouterr().out
    with pytest.raises(CalibrationError, match="No such file"):
        compare_files(tmp_path / "none", a)
