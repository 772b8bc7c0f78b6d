"""COLMAP's database and models are the same every time, and numbered as the scan is."""

import sqlite3

import numpy as np
import pytest
from synthetic.scans import simulation

from graphs.lenses import LENS_NAMES, PARAMETER_NAMES, Camera
from sfm_calib import colmap
from sfm_calib.cache import Cache
from sfm_calib.images import read_scan


def quiet(stage: str, done: int, total: int) -> None:
    """Progress that nobody watches."""


def mapped(scan, place):
    """Database content and the largest model of a scan, made from nothing."""
    place.mkdir()
    database = place / "database.db"
    colmap.extract_features(scan, ["radtan"] * 2, {}, database, 250, quiet)
    n = len(scan.images)
    pairs = [(a, b) for a in range(n) for b in range(a + 1, n)]
    colmap.match_features(scan, pairs, database, 0, quiet)
    with sqlite3.connect(database) as db:
        tables = ("images", "cameras", "keypoints", "descriptors", "two_view_geometries")
        content = {t: db.execute(f"select * from {t} order by 1").fetchall() for t in tables}
    models = colmap.map_images(scan, database, place / "models", colmap.attempts(0)[0], quiet)
    return content, colmap.free_model(models[0], scan, ["radtan"] * 2)


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


@pytest.mark.parametrize("lens", LENS_NAMES)
def test_cameras_survive_the_way_through_colmap(lens):
    names = PARAMETER_NAMES[lens]
    params = np.array([500.0, 500.0, 310.0, 250.0, -0.1, 0.02, 0.001, -0.002])[: len(names)]
    camera = Camera("a", lens, (640, 480), params)
    there = colmap.colmap_camera(camera, colmap.MAPPING_MODEL[lens])
    back = colmap.camera_from_colmap("a", lens, there)
    known = len(back.params) if lens not in ("radtan", "kannala_brandt") else 6
    np.testing.assert_allclose(back.params[:known], params[:known])
    np.testing.assert_array_equal(back.params[known:], 0.0)
    assert there.principal_point_x == 310.5 and there.principal_point_y == 250.5
