"""What rig.yaml knows: relative to the reference camera, checked, and used where it helps."""

from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
from synthetic.scans import QUICK, simulation

from graphs.camera import Camera, nominal_params
from graphs.frames import Transform
from graphs.lenses import LENS_NAMES, LENSES, LensName
from graphs.problem import Estimate
from sfm_calib import colmap, mapping
from sfm_calib.cache import Cache
from sfm_calib.cli import main
from sfm_calib.config import RigConfig, ScaleConfig, load_rig_config
from sfm_calib.errors import CalibrationError
from sfm_calib.images import Scan, ScanImage, read_scan
from sfm_calib.nominal import (
    check_config,
    known_cameras,
    lens_of,
    nominal_rig,
    rig_priors,
    start_from_config,
)
from sfm_calib.result import load_calibration
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

SIZE = (640, 480)
TURN = Transform.exp(np.array([0.1, -0.2, 0.3]), np.array([0.5, 0.1, -0.2]))
OTHER = Transform.exp(np.array([-0.3, 0.1, 0.0]), np.array([-0.2, 0.0, 0.1]))


def entry(transform: Transform, **sigmas: float) -> dict[str, object]:
    return {
        "rotation_wxyz": transform.rotation_wxyz.tolist(),
        "translation": transform.translation.tolist(),
        **sigmas,
    }


def rig(**cameras: dict[str, object]) -> RigConfig:
    return RigConfig.model_validate(
        {"cameras": {name: {"cam_from_rig": said} for name, said in cameras.items()}}
    )


def scan_of(*paths: tuple[int, int, str]) -> Scan:
    images = tuple(ScanImage(*path) for path in paths)
    return Scan(Path(), ("a", "b"), (SIZE, SIZE), ("0", "1"), images)


def camera(name: str) -> Camera:
    return Camera(name, "radial", SIZE, nominal_params("radial", SIZE, 500.0))


def test_a_nominal_rig_is_told_from_the_reference_camera() -> None:
    told = nominal_rig(rig(a=entry(TURN), b=entry(OTHER)), ("a", "b"), 0)
    assert told is not None
    np.testing.assert_allclose(told[0].rotation, np.eye(3), atol=1e-12)
    expected = OTHER @ TURN.inverse
    np.testing.assert_allclose(told[1].rotation, expected.rotation, atol=1e-12)
    np.testing.assert_allclose(told[1].translation, expected.translation, atol=1e-12)


def test_half_a_nominal_rig_is_none() -> None:
    assert nominal_rig(rig(a=entry(TURN)), ("a", "b"), 0) is None
    assert nominal_rig(rig(b=entry(TURN)), ("a", "b"), 0) is not None


def test_rig_priors_need_a_sigma_and_translations_a_scale() -> None:
    start = Estimate((camera("a"), camera("b")), (TURN, OTHER), (), np.zeros((0, 3)))
    assert rig_priors(start, rig(b=entry(OTHER)), 0, False) == {}
    said = rig(a=entry(TURN), b=entry(OTHER, sigma_rotation_deg=2.0, sigma_translation=0.01))
    prior = rig_priors(start, said, 0, False)[1]
    expected = OTHER @ TURN.inverse
    np.testing.assert_allclose(prior.cam_from_rig.rotation, expected.rotation, atol=1e-12)
    assert prior.sigma_rotation == pytest.approx(np.radians(2.0))
    assert prior.sigma_translation == np.inf
    baseline = {"cameras": ["a", "b"], "length_m": 1, "sigma_m": 0.1}
    path = {"between": ["0", "1"], "length_m": 1, "sigma_m": 0.1}
    for scale in ({"baseline": baseline}, {"frames": path}):
        metric = said.model_copy(update={"scale": ScaleConfig.model_validate(scale)})
        assert rig_priors(start, metric, 0, True)[1].sigma_translation == 0.01


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"sigma": {"fx": 3.0}}, "params.fx"),
        ({"fixed": ["fy"]}, "params.fy"),
        ({"params": {"k3": 0.1}}, "k3"),
        ({"sigma": {"cx": 1.0}, "params": {"cy": 240.0}}, "params.cx"),
    ],
)
def test_a_belief_without_a_value_is_refused(said: dict[str, object], message: str) -> None:
    config = RigConfig.model_validate({"cameras": {"a": said}})
    with pytest.raises(CalibrationError, match=message):
        check_config(config, scan_of((0, 0, "a/0.png"), (1, 0, "b/0.png")))


def test_the_lens_of_a_rig_and_of_a_lone_camera() -> None:
    assert lens_of(RigConfig(), "a", 2) == "radtan"
    assert lens_of(RigConfig(), "a", 1) == "radial"
    assert lens_of(RigConfig(lens="pinhole"), "a", 2) == "pinhole"


def test_a_parameter_is_told_by_its_lens() -> None:
    scan = scan_of((0, 0, "a/0.png"), (1, 0, "b/0.png"))
    said = {"cameras": {"a": {"lens": "brown", "params": {"k3": 0.1}}}}
    check_config(RigConfig.model_validate(said), scan)
    said = {"cameras": {"a": {"lens": "eucm", "params": {"aplha": 0.6}}}}
    with pytest.raises(
        CalibrationError, match=r"did you mean 'alpha'\? it has fx, fy, cx, cy, alph"
    ):
        check_config(RigConfig.model_validate(said), scan)


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_a_given_focal_length_is_that_of_both_axes_and_the_rest_nominal(lens: LensName) -> None:
    said = {"cameras": {"b": {"lens": lens, "params": {"fx": 333.0, "cy": 200.0}}}}
    known = known_cameras(RigConfig.model_validate(said), scan_of((0, 0, "a"), (1, 0, "b")))
    assert list(known) == [1]
    np.testing.assert_allclose(known[1].params[:4], [333, 333, 319.5, 200])
    np.testing.assert_array_equal(known[1].params[4:], LENSES[lens].nominal)


def test_rig_mapping_needs_frames_that_are_named_alike() -> None:
    assert colmap.can_constrain(scan_of((0, 0, "a/0.png"), (1, 0, "b/0.png")))
    assert not colmap.can_constrain(scan_of((0, 0, "a/0.png"), (1, 0, "b/7.png")))


def test_held_parameters_start_where_they_are_held(good_problem) -> None:
    config = RigConfig.model_validate({"cameras": {"cam0": {"fixed": ["k1", "cx"]}}})
    start = start_from_config(good_problem, config).initial.cameras[0].named()
    before = good_problem.initial.cameras[0].named()
    assert start["k1"] == 0.0 and start["cx"] == (SIZE[0] - 1) / 2
    assert start["fx"] == before["fx"] and start["k2"] == before["k2"]


@pytest.fixture
def good_problem():
    return simulate_tracks(TrackOptions(frames=6, points=300), np.random.default_rng(0))[0]


@pytest.mark.slow
def test_a_nominal_rig_is_imposed_on_the_mapping(tmp_path, monkeypatch) -> None:
    """Free mapping that finds nothing leaves the field to the mapping with the nominal rig."""
    copytree(simulation() / "scan", tmp_path / "scan")
    truth = load_calibration(simulation() / "truth.json")
    given = rig(cam1=entry(truth.cam_from_rig("cam1")))
    scan = read_scan(tmp_path / "scan", Cache(tmp_path / "cache"), "stem", 10, lambda *done: None)
    assert main(["calibrate", str(tmp_path / "scan"), "-o", str(tmp_path / "out"), *QUICK]) == 0
    database = tmp_path / "out" / "cache" / "matches" / mapping.DATABASE
    real, calls = colmap.map_images, []

    def free_fails(scan, database, out, attempt, progress):
        calls.append(out.name)
        return real(scan, database, out, attempt, progress) if out.name == "rig" else []

    monkeypatch.setattr(colmap, "map_images", free_fails)
    config = load_rig_config(tmp_path / "scan" / "rig.yaml").model_copy(
        update={"cameras": given.cameras}
    )
    nominal = nominal_rig(config, scan.cameras, 0)
    (tmp_path / "models").mkdir()
    mapping.map_matched(scan, config, nominal, database, tmp_path / "models", lambda *done: None)
    assert calls == ["free0", "free1", "free2", "rig"]
    found = colmap.read_models(tmp_path / "models")[0]
    model = colmap.free_model(found, scan, ["radtan"] * 2, colmap.keypoint_scales(database))
    relative = {
        frame: model.cam_from_world[1, frame] @ model.cam_from_world[0, frame].inverse
        for frame in model.images_of(0)
    }
    assert len(relative) == len(scan.frames)
    rotations = np.array([t.rotation for t in relative.values()])
    np.testing.assert_allclose(rotations, np.broadcast_to(rotations[0], rotations.shape), atol=1e-9)
