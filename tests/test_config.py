"""rig.yaml: a table of good and bad files, each bad one with the line that it earns."""

from typing import get_args

import pytest
from synthetic.scans import picture, silent

from graphs.losses import LossChoice
from sfm_calib.cache import Cache
from sfm_calib.config import Options, RigConfig, load_rig_config
from sfm_calib.errors import CalibrationError, nearest
from sfm_calib.images import read_scan
from sfm_calib.nominal import check_config

CLICK = "{camera: a, frame: '01', pixel: [1, 2.5]}"
MARK = f"[{CLICK}, {CLICK}, {CLICK}]"
GOOD = {
    "an empty file": "",
    "a comment": "# nothing yet",
    "options": "lens: radtan\nmax_features: 500\nseed: 3",
    "numbers as YAML 1.1 misreads them": "aspect_sigma: 1e-2",
    "a camera": "cameras: {left: {lens: pinhole, params: {fx: 500}, sigma: {fx: 2}, fixed: [cy]}}",
    "a camera of which nothing is said": "cameras: {left: {}}",
    "a nominal rig": "cameras: {left: {cam_from_rig: {rotation_wxyz: [0.71, 0, 0.71, 0]}}}",
    "a baseline": "scale: {baseline: {cameras: [a, b], length_m: 0.2, sigma_m: 0.001}}",
    "a path": "scale: {frames: {between: ['000000', '000009'], length_m: 4, sigma_m: 0.1}}",
    "two marks": f"scale: {{points: {{between: [{MARK}, {MARK}], length_m: 1, sigma_m: 0.1}}}}",
    "rough clicks": (
        f"scale: {{points: {{between: [{MARK}, {MARK}], length_m: 1, sigma_m: 0.1, "
        "click_sigma_px: 2.5}}"
    ),
    "no scale": "scale: {}",
    "empty scales": "scale: {baseline: , frames: []}",
    "several scales": (
        "scale: {baseline: {cameras: [a, b], length_m: 1, sigma_m: 1}, frames: ["
        "{between: ['1', '2'], length_m: 1, sigma_m: 1}, "
        "{between: ['2', '3'], length_m: 1, sigma_m: 1}]}"
    ),
    **{f"the loss {name}": f"loss: {name}" for name in get_args(LossChoice)},
}
BAD = {
    "unknown key": ("lense: radtan", "unknown key 'lense': did you mean 'lens'?"),
    "unknown key of a camera": (
        "cameras: {left: {parms: {}}}",
        "unknown key 'cameras.left.parms': did you mean 'params'?",
    ),
    "unknown key of a transform": (
        "cameras: {left: {cam_from_rig: {rotation: [1, 0, 0, 0]}}}",
        "did you mean 'rotation_wxyz'?",
    ),
    "unknown key of a baseline": (
        "scale: {baseline: {cameras: [a, b], length: 1, sigma_m: 1}}",
        "did you mean 'length_m'?",
    ),
    "unknown scale": ("scale: {base: 1}", "did you mean 'baseline'?"),
    "unknown key of a path": (
        "scale: {frames: {betwen: ['1', '2'], length_m: 1, sigma_m: 1}}",
        "unknown key 'scale.frames.betwen': did you mean 'between'? Valid here: between, length_m",
    ),
    "unknown key of points": (
        f"scale: {{points: {{between: [{MARK}, {MARK}], length_m: 1, sigma_m: 1, "
        "click_sigma: 1}}",
        "'scale.points.click_sigma': did you mean 'click_sigma_px'?",
    ),
    "unknown key of a click": (
        f"scale: {{points: {{between: [{MARK}, {MARK.replace('pixel', 'pixels')}], length_m: 1, "
        "sigma_m: 1}}",
        "'scale.points.between.1.0.pixels': did you mean 'pixel'? Valid here: camera, frame, pixel",
    ),
    "the second of several paths": (
        "scale: {frames: [{between: ['1', '2'], length_m: 1, sigma_m: 1}, "
        "{between: ['2', '3'], length_m: 1, sigma_m: 0}]}",
        "scale.frames.1.sigma_m: Input should be greater than 0 (got 0)",
    ),
    "unknown key of the second of several paths": (
        "scale: {frames: [{between: ['1', '2'], length_m: 1, sigma_m: 1}, "
        "{between: ['2', '3'], length: 1, sigma_m: 1}]}",
        "unknown key 'scale.frames.1.length': did you mean 'length_m'? Valid here: between, len",
    ),
    "unknown key of a click of several": (
        f"scale: {{points: [{{between: [{MARK}, {MARK.replace('pixel', 'pixels')}], length_m: 1, "
        "sigma_m: 1}]}",
        "'scale.points.0.between.1.0.pixels': did you mean 'pixel'? Valid here: camera, frame, pix",
    ),
    "a number for a baseline": ("scale: {baseline: 0.2}", "scale.baseline: Input should be a "),
    "a number among baselines": ("scale: {baseline: [0.2]}", "scale.baseline.0: Input should be"),
    "a path of no length": (
        "scale: {frames: {between: ['1', '2'], length_m: 0, sigma_m: 1}}",
        "scale.frames.length_m: Input should be greater than 0 (got 0)",
    ),
    "a span of negative length": (
        f"scale: {{points: {{between: [{MARK}, {MARK}], length_m: -2, sigma_m: 1}}}}",
        "scale.points.length_m: Input should be greater than 0 (got -2)",
    ),
    "two clicks": (
        f"scale: {{points: {{between: [{MARK}, [{CLICK}, {CLICK}]], length_m: 1, sigma_m: 1}}}}",
        "scale.points.between: the second mark has 2 clicks and needs 3: click it in more images",
    ),
    "one mark": (
        f"scale: {{points: {{between: [{MARK}], length_m: 1, sigma_m: 1}}}}",
        "scale.points.between.1: Field required",
    ),
    "a click of one number": (
        f"scale: {{points: {{between: [{MARK}, {MARK.replace(', 2.5', '')}], length_m: 1, "
        "sigma_m: 1}}",
        "scale.points.between.1.0.pixel.1: Field required",
    ),
    "exact clicks": (
        f"scale: {{points: {{between: [{MARK}, {MARK}], length_m: 1, sigma_m: 1, "
        "click_sigma_px: 0}}",
        "scale.points.click_sigma_px: Input should be greater than 0 (got 0)",
    ),
    "a frame that YAML takes for a number": (
        "scale: {frames: {between: [000000, 000009], length_m: 1, sigma_m: 1}}",
        "scale.frames.between.0: the name 0 is a int; put it in quotes",
    ),
    "a reference that YAML takes for a number": ("reference: 0", "the name 0 is a int; put it in"),
    "an unknown loss": ("loss: caucy", "'geman_mcclure' or 'adaptive' (got 'caucy')"),
    "wrong type": ("max_features: many", "max_features: Input should be a valid integer"),
    "wrong type shows the value": ("max_features: many", "(got 'many')"),
    "a list for a mapping": ("cameras: [left, right]", "cameras: Input should be a valid dict"),
    "an unknown lens": ("lens: fisheye", "'double_sphere' or 'auto' (got 'fisheye')"),
    "out of range": ("max_features: 5", "greater than or equal to 100 (got 5)"),
    "not a number": ("cameras: {left: {params: {fx: .nan}}}", "cameras.left.params.fx: "),
    "an infinite sigma": ("principal_point_sigma: .inf", "principal_point_sigma: "),
    "a sigma of zero": ("cameras: {left: {sigma: {fx: 0}}}", "greater than 0 (got 0)"),
    "a negative focal length": ("cameras: {left: {params: {fx: -3}}}", "fx is -3 and must be"),
    "a quaternion of zeros": (
        "cameras: {left: {cam_from_rig: {rotation_wxyz: [0, 0, 0, 0]}}}",
        "a rotation has length 1 and this has 0",
    ),
    "three numbers for a quaternion": (
        "cameras: {left: {cam_from_rig: {rotation_wxyz: [1, 0, 0]}}}",
        "rotation_wxyz.3: Field required",
    ),
    "a missing sigma": ("scale: {baseline: {cameras: [a, b], length_m: 1}}", "sigma_m: Field req"),
    "a camera called 0": ("cameras: {0: {}}", "the name 0 is a int; put it in quotes"),
    "a list": ("- left\n- right", "holds one list, not keys and values"),
    "a word": ("radtan", "holds one str, not keys and values"),
    "invalid YAML": ("lens: radtan\ncameras: {left", "is not valid YAML in line 2"),
    "a tab": ("cameras:\n\tleft: {}", "is not valid YAML in line 2: found character"),
    "an impossible date": ("lens: 2020-99-99", "is not valid YAML: month must be"),
}


@pytest.mark.parametrize("text", GOOD.values(), ids=GOOD)
def test_good_files(tmp_path, text):
    (tmp_path / "rig.yaml").write_text(text)
    assert isinstance(load_rig_config(tmp_path / "rig.yaml"), RigConfig)


@pytest.mark.parametrize(("text", "message"), BAD.values(), ids=BAD)
def test_bad_files(tmp_path, text, message):
    (tmp_path / "rig.yaml").write_text(text)
    assert message in refusal(tmp_path / "rig.yaml")


def refusal(path):
    with pytest.raises(CalibrationError) as caught:
        load_rig_config(path)
    text = str(caught.value)
    assert str(path.with_suffix("")) in text and "\n" not in text
    return text


def test_no_file_is_an_empty_one(tmp_path):
    assert load_rig_config(tmp_path / "rig.yaml") == RigConfig()


def test_files_that_are_no_text(tmp_path):
    (tmp_path / "rig.yaml").write_bytes(b"\x89PNG\r\n\x1a\n\xff\xfe")
    assert "is no text: byte 0 is not UTF-8" in refusal(tmp_path / "rig.yaml")
    (tmp_path / "rig.yaml").write_bytes(b"lens: \x00")
    assert "is not valid YAML" in refusal(tmp_path / "rig.yaml")
    (tmp_path / "rig.yaml").unlink()
    (tmp_path / "rig.yaml").mkdir()
    assert "Is a directory" in refusal(tmp_path / "rig.yaml")


def test_a_file_called_yml_is_not_passed_by(tmp_path):
    (tmp_path / "rig.yml").write_text("lens: radtan")
    assert "rig.yml is not read: call it rig.yaml" in refusal(tmp_path / "rig.yaml")
    (tmp_path / "rig.yaml").write_text("")
    load_rig_config(tmp_path / "rig.yaml")


def test_every_option_of_the_file_is_an_option_of_the_program():
    config = RigConfig(lens="radtan", max_features=500)
    assert config.options() == Options(lens="radtan", max_features=500)
    changed = config.with_options(Options(seed=7))
    assert (changed.lens, changed.seed) == ("auto", 7)


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    folder = tmp_path_factory.mktemp("config")
    for camera in ("left", "right"):
        for number in range(3):
            picture(folder / "scan" / camera / f"{number}.png")
    return read_scan(folder / "scan", Cache(folder / "cache"), "stem", 10, silent)


UNKNOWN = {
    "camera": ({"cameras": {"letf": {}}}, "has no camera 'letf'; did you mean 'left'?"),
    "reference": ({"reference": "rihgt"}, "reference: the scan has no camera 'rihgt'"),
    "baseline": (
        {"scale": {"baseline": {"cameras": ["left", "top"], "length_m": 1, "sigma_m": 1}}},
        "scale.baseline.cameras: the scan has no camera 'top'; it has left, right",
    ),
    "parameter": ({"cameras": {"left": {"params": {"k9": 1}}}}, "a parameter 'k9'"),
    "baseline to itself": (
        {"scale": {"baseline": {"cameras": ["left", "left"], "length_m": 1, "sigma_m": 1}}},
        "a baseline from left to itself; name two cameras",
    ),
    "frame": (
        {"scale": {"frames": {"between": ["0", "7"], "length_m": 1, "sigma_m": 1}}},
        "scale.frames.between: the scan has no frame '7'; it has 0, 1, 2",
    ),
    "path to itself": (
        {"scale": {"frames": {"between": ["1", "1"], "length_m": 1, "sigma_m": 1}}},
        "a distance from 1 to itself; name two frames",
    ),
    "frame of the second of two paths": (
        {
            "scale": {
                "frames": [
                    {"between": ["0", "1"], "length_m": 1, "sigma_m": 1},
                    {"between": ["0", "7"], "length_m": 1, "sigma_m": 1},
                ]
            }
        },
        "scale.frames.1.between: the scan has no frame '7'; it has 0, 1, 2",
    ),
}


@pytest.mark.parametrize(("config", "message"), UNKNOWN.values(), ids=UNKNOWN)
def test_names_that_the_scan_does_not_have(scan, config, message):
    with pytest.raises(CalibrationError) as caught:
        check_config(RigConfig.model_validate(config), scan)
    assert message in str(caught.value)


def test_many_names_are_not_all_listed():
    frames = [f"{i:06d}" for i in range(51)]
    assert nearest("00033", frames) == "did you mean '000033'? it has 51, 000000 to 000050"
    assert nearest("x", frames[:3]) == "it has 000000, 000001, 000002"
