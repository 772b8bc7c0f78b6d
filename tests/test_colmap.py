"""COLMAP's models are the same every time, numbered as the scan is, and hold our lenses."""

import sqlite3
from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
from synthetic.cameras import camera_of
from synthetic.scans import simulation

from graphs.camera import project, unproject
from graphs.frames import Transform
from graphs.lenses import LENS_NAMES, PARAMETER_NAMES
from sfm_calib import colmap, colmap_matches
from sfm_calib.cache import Cache
from sfm_calib.colmap_lenses import EXACT_MODEL, LENS_OF_MODEL, MAPPING_MODEL
from sfm_calib.images import Scan, ScanImage, read_scan
from sfm_calib.mapping_attempts import attempts


def quiet(stage: str, done: int, total: int) -> None:
    """Progress that nobody watches."""


def mapped(scan, place):
    """Database content and the largest model of a scan, made from nothing."""
    place.mkdir()
    database = place / "database.db"
    colmap.extract_features(scan, ["radtan"] * 2, {}, database, 250, 1.0, quiet)
    n = len(scan.images)
    pairs = [(a, b) for a in range(n) for b in range(a + 1, n)]
    colmap_matches.match_features(scan, pairs, database, 0, quiet)
    with sqlite3.connect(database) as db:
        tables = ("images", "cameras", "keypoints", "descriptors", "two_view_geometries")
        content = {t: db.execute(f"select * from {t} order by 1").fetchall() for t in tables}
    models = colmap.map_images(scan, database, place / "models", attempts(0)[0], quiet)
    scales = colmap.keypoint_scales(database)
    return content, colmap.free_model(models[0], scan, ["radtan"] * 2, scales)


@pytest.mark.slow
def test_tracks_and_models_are_the_same_every_time(tmp_path):
    scan = read_scan(simulation() / "scan", Cache(tmp_path / "cache"), "stem", 10, quiet)
    content, model = mapped(scan, tmp_path / "a")
    again, model_again = mapped(scan, tmp_path / "b")
    assert content == again
    assert [row[1] for row in content["images"]] == [image.path for image in scan.images]
    assert [row[2] for row in content["images"]] == [1] * 8 + [2] * 8  # one camera a folder
    np.testing.assert_array_equal(model.points, model_again.points)
    np.testing.assert_array_equal(model.observations.pixels, model_again.observations.pixels)
    for ours, others in zip(model.cameras, model_again.cameras, strict=True):
        np.testing.assert_array_equal(ours.params, others.params)


@pytest.mark.parametrize("image_scale", [1.0, 0.5])
def test_features_of_reduced_images_are_where_those_of_whole_ones_are(image_scale, tmp_path):
    y, x = np.mgrid[:240, :320]
    known = np.array([(40 + 48 * i + 0.37 * j, 40 + 40 * j) for i in range(6) for j in range(5)])
    blobs = sum(150 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / 50) for u, v in known)
    cv2.imwrite(str(tmp_path / "0.png"), (50 + blobs).astype(np.uint8))
    scan = Scan(tmp_path, ("a",), ((320, 240),), ("0",), (ScanImage(0, 0, "0.png"),))
    database = tmp_path / "database.db"
    colmap.extract_features(scan, ["radial"], {}, database, 1000, image_scale, quiet)
    with pycolmap.Database.open(database) as db:
        keypoints = np.asarray(db.read_keypoints(1))
    apart = np.linalg.norm(keypoints[:, None, :2] - colmap.PIXEL_OFFSET - known, axis=-1)
    off = (keypoints[apart.argmin(0), :2] - colmap.PIXEL_OFFSET - known)[apart.min(0) < 1]
    assert len(off) > 25
    assert np.abs(off.mean(0)).max() < 0.06  # a convention missed is a quarter or half a pixel
    size = colmap.keypoint_scales(database)["0.png"][apart.argmin(0)]
    assert np.median(size) == pytest.approx(5, rel=0.25)


@pytest.mark.parametrize("reference", [0, 1])
def test_any_camera_can_be_the_rigs_reference(reference, tmp_path):
    database, images = tmp_path / "database.db", []
    with pycolmap.Database.open(database) as db:
        for index, name in enumerate("ab"):
            camera = pycolmap.Camera(model="PINHOLE", width=64, height=48, params=[60, 60, 32, 24])
            number = db.write_camera(camera)
            for frame in range(2):
                image = ScanImage(index, frame, f"{name}/{frame}.png")
                images.append(image)
                db.write_image(pycolmap.Image(name=image.path, camera_id=number))
    scan = Scan(tmp_path, ("a", "b"), ((64, 48),) * 2, ("0", "1"), tuple(images))
    places = [Transform.identity(), Transform.exp(np.array([0.1, 0.2, 0.3]), np.array([1, 2, 3]))]
    own = places[reference].inverse
    colmap.constrain_rig(scan, [place @ own for place in places], reference, database)
    with pycolmap.Database.open(database) as db:
        (rig,) = db.read_all_rigs()
    assert rig.num_sensors() == 2 and rig.ref_sensor_id.id == reference + 1


def grid():
    return np.stack(np.meshgrid(np.linspace(0, 639, 16), np.linspace(0, 479, 12)), axis=-1)


def apart_px(camera, other):
    """How far apart the two put the rays of the first one's pixels."""
    return np.linalg.norm(project(other, unproject(camera, grid())) - grid(), axis=-1)


def square(lens, coefficients=None):
    """A camera of the lens with one focal length, as while mapping."""
    camera = camera_of(lens, coefficients)
    camera.params[1] = camera.params[0]
    return camera


SMALLER = {  # what the mapping model has of the lens
    "pinhole": (),
    "simple_radial": (-0.1,),
    "radial": (-0.1, 0.02),
    "radtan": (-0.1, 0.02, 0.0, 0.0),
    "brown": (-0.1, 0.02, 0.0, 0.0, 0.0),
    "rational": (-0.1, 0.02, *[0.0] * 6),
    "thin_prism": (-0.1, 0.02, *[0.0] * 10),
    "kannala_brandt": (-0.03, 0.01, 0.0, 0.0),
    "division": (-0.17,),
}


@pytest.mark.parametrize("lens", SMALLER)
def test_what_the_mapping_model_has_survives_the_way_through_colmap(lens):
    camera = square(lens, SMALLER[lens])
    there = colmap.colmap_camera(camera, MAPPING_MODEL[lens])
    back = colmap.camera_from_colmap("cam", lens, there)
    np.testing.assert_allclose(back.params, camera.params)
    assert (back.name, back.lens, back.size) == (camera.name, lens, camera.size)
    assert (there.principal_point_x, there.principal_point_y) == (330.5, 231.5)


@pytest.mark.parametrize("lens", EXACT_MODEL)
def test_the_exact_model_loses_nothing(lens):
    camera = camera_of(lens)
    back = colmap.camera_from_colmap("cam", lens, colmap.colmap_camera(camera, EXACT_MODEL[lens]))
    np.testing.assert_array_equal(back.params, camera.params)


def test_tangential_terms_are_left_out_and_the_rest_stays():
    there = colmap.colmap_camera(square("radtan"), "RADIAL")
    np.testing.assert_allclose(there.params, [520, 330.5, 231.5, -0.31, 0.11])


@pytest.mark.parametrize("lens", ["brown", "rational", "kannala_brandt", "eucm", "double_sphere"])
def test_what_the_mapping_model_has_not_is_made_up_for(lens):
    """Left out, k3 to k6 alone would move the corners by many pixels."""
    camera = square(lens)
    if "p1" in camera.names:  # left out on purpose
        camera.params[6:8] = 0
    back = colmap.camera_from_colmap("cam", lens, colmap.colmap_camera(camera, MAPPING_MODEL[lens]))
    assert np.sqrt((apart_px(camera, back) ** 2).mean()) < 0.5
    params = np.where(np.isin(camera.names, ["k3", "k4", "k5", "k6"]), 0, camera.params)
    shorter = replace(camera, params=params)
    assert lens in ("eucm", "double_sphere") or np.nanmax(apart_px(camera, shorter)) > 2


def test_every_lens_maps_with_one_focal_length():
    for lens in LENS_NAMES:
        model = pycolmap.Camera.create_from_model_name(1, MAPPING_MODEL[lens], 500.0, 640, 480)
        names = colmap.parameter_names(model)
        assert "f" in names and "fx" not in names
        known = {"f", *PARAMETER_NAMES[LENS_OF_MODEL[MAPPING_MODEL[lens]]]}
        assert set(names) <= known
    for lens, model in EXACT_MODEL.items():
        exact = pycolmap.Camera.create_from_model_name(1, model, 500.0, 640, 480)
        assert set(PARAMETER_NAMES[lens]) <= set(colmap.parameter_names(exact))


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_a_mapped_camera_starts_any_lens(lens):
    """COLMAP's own first guess, undistorted: ours sees the whole image as it does."""
    model = pycolmap.Camera.create_from_model_name(1, MAPPING_MODEL[lens], 400.0, 640, 480)
    camera = colmap.camera_from_colmap("cam", lens, model)
    rays = unproject(camera, grid())
    assert np.isfinite(rays).all()
    ahead = rays[..., 2] > 0
    theirs = [model.img_from_cam(ray) for ray in rays[ahead]]
    np.testing.assert_allclose(grid()[ahead] + 0.5, theirs, atol=0.2)


def test_descriptors_are_read_largest_first(tmp_path):
    database, rng = tmp_path / "database.db", np.random.default_rng(0)
    sizes, found = np.array([1.0, 4.0, 2.0]), rng.integers(0, 255, (3, 128)).astype(np.uint8)
    images = tuple(ScanImage(0, frame, f"{frame}.png") for frame in range(3))
    with pycolmap.Database.open(database) as db:
        camera = pycolmap.Camera(model="PINHOLE", width=64, height=48, params=[60, 60, 32, 24])
        number = db.write_camera(camera)
        for image in reversed(images):  # numbered otherwise than in the scan
            key = db.write_image(pycolmap.Image(name=image.path, camera_id=number))
            columns = [np.ones(3), np.ones(3), *sizes * [[1], [0], [0], [1]]]
            keypoints = np.stack(columns[: 2 if image.frame == 2 else 6], axis=1)
            shown = keypoints[: 0 if image.frame == 1 else 3].astype(np.float32)
            db.write_keypoints(key, shown)
            sift = pycolmap.FeatureExtractorType.SIFT
            own = found[: len(shown)] + np.uint8(image.frame)
            db.write_descriptors(key, pycolmap.FeatureDescriptors(sift, own))
    scan = Scan(tmp_path, ("a",), ((64, 48),), ("0", "1", "2"), images)
    with colmap.open_descriptors(scan, database) as read:
        np.testing.assert_array_equal(read(0), found[[1, 2, 0]])
        assert read(1).shape == (0, 128)
        np.testing.assert_array_equal(read(2), found + np.uint8(2))  # places alone: as they lie
