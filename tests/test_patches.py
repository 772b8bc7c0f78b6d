"""Least-squares matching, on pictures of walls where every pixel is known to rounding."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from synthetic import walls
from synthetic.scans import silent
from synthetic.walls import CAMERA, DISTANCES, NORMALS, Scene, Walls, scene

from graphs.camera import project
from graphs.frames import FloatArray
from graphs.noise import RAYLEIGH_MEDIAN
from graphs.problem import BoolArray, residuals_px
from sfm_calib.errors import CalibrationError
from sfm_calib.patches import match
from sfm_calib.patches.crops import MARGIN, Images, cut_out
from sfm_calib.patches.match import Matches, Sights, match_patches
from sfm_calib.patches.rounds import is_good
from sfm_calib.patches.warps import HALF, monomials, steps_px, warps_of

pytest.importorskip("torch", reason="torch is an extra: pip install 'sfm_calib[learned]'")
pytest.importorskip("kornia", reason="kornia is an extra: pip install 'sfm_calib[learned]'")


@pytest.fixture
def back_wall(monkeypatch: pytest.MonkeyPatch) -> None:
    """The room's back wall alone: corners, where a patch lies on two, are none."""
    alone = np.array([DISTANCES[0], 1e9, 1e9])
    monkeypatch.setattr(walls, "DISTANCES", alone)
    monkeypatch.setitem(globals(), "DISTANCES", alone)


@cache
def drawn(noise: float = 1.0, keypoint_px: float = 0.4, scale: float = 1.5) -> Scene:
    return scene(noise=noise, keypoint_px=keypoint_px, scale=scale)


def matched(one: Scene, folder: Path, images: list[np.ndarray] | None = None) -> Matches:
    paths = []
    for index, image in enumerate(images or one.images):
        paths.append(folder / f"{index}.png")
        cv2.imwrite(str(paths[-1]), image)
    seen = one.problem.observations
    unknown = np.full_like(one.true.initial.points, np.nan)
    sights = Sights(one.true.initial, seen, seen.pixels, unknown, seen.frame, Images(paths))
    return match_patches(sights, "cpu", silent)


def errors(one: Scene, found: Matches, good: BoolArray | None = None) -> FloatArray:
    """Pixels (n_obs, 2) from where each view shows what its track's good views show together.

    A track may lie anywhere on its wall: the place is the one that suits its pixels best.
    """
    start, seen = one.true.initial, one.true.observations
    good = np.ones(len(seen), dtype=bool) if good is None else good
    n = len(start.points)
    wall = np.abs(start.points @ NORMALS.T - DISTANCES).argmin(1)
    along = np.linalg.svd(NORMALS[wall][:, None])[2][:, 1:]  # (n, 2, 3)

    def shown(places: FloatArray) -> FloatArray:
        return seen.pixels + residuals_px(replace(start, points=places), seen)

    places = start.points
    for _ in range(3):
        now = shown(places)
        slope = [(shown(places + 1e-6 * along[:, k]) - now) / 1e-6 for k in range(2)]
        J = np.stack(slope, -1) * good[:, None, None]
        H, g = 1e-12 * np.tile(np.eye(2), (n, 1, 1)), np.zeros((n, 2))
        np.add.at(H, seen.point, J.mT @ J)
        np.add.at(g, seen.point, np.einsum("nij,ni->nj", J, found.pixels - now))
        places = places + np.einsum("nk,nkj->nj", np.linalg.solve(H, g[..., None])[..., 0], along)
    return found.pixels - shown(places)


def left(one: Scene) -> FloatArray:
    """How much of an error (n_obs,) is left, of variance, once what a track shares is taken."""
    return 1 - 1 / np.bincount(one.true.observations.point)[one.true.observations.point]


def of_first(one: Scene, n_frames: int) -> Scene:
    """The scene as its first frames saw it, with the points that all of them have."""
    seen = one.true.observations
    early = seen.frame < n_frames
    early &= np.bincount(seen.point[early], minlength=len(one.true.initial.points))[seen.point] == (
        n_frames
    )
    parts = [replace(p, observations=p.observations.subset(early)) for p in (one.true, one.problem)]
    return Scene(parts[0], parts[1], one.images)


def nees_of(one: Scene, found: Matches) -> FloatArray:
    """Squared errors (n_obs, 2) over the stated covariance, along its axes; one of such is right
    where its median is that of a squared normal: 1, as it is scaled here."""
    share = left(one)
    off = errors(one, found) / np.sqrt(np.where(share > 0, share, np.nan))[:, None]
    size, directions = np.linalg.eigh(found.cov_px)
    return np.einsum("nij,ni->nj", directions, off) ** 2 / size / 0.455


def typical(values: FloatArray) -> float:
    """Sigma of a coordinate of errors (n, 2) by their median: corners of the room bend some."""
    return float(np.median(np.linalg.norm(values, axis=1)) / RAYLEIGH_MEDIAN)


# ---- warps ----------------------------------------------------------------------------------


def test_a_warp_shows_the_plane_across_the_view_through_every_lens() -> None:
    one = drawn()
    start, seen = one.true.initial, one.true.observations
    warps = warps_of(start, seen, seen.pixels)
    centres = np.array([t.inverse.translation for t in start.rig_from_world])
    step = steps_px(seen)[0]
    samples = np.array([(0.0, 0.0), (HALF, -HALF), (-HALF, 2.0), (3.0, HALF)])
    checked = 0
    for row in range(0, len(seen), 7):
        own = np.flatnonzero(seen.point == seen.point[row])
        point = start.points[seen.point[row]]
        towards = centres[seen.frame[own]] - point
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        normal = towards.mean(0)
        # the reference looks most along the normal
        reference = own[np.argmax(towards @ normal)]
        assert warps.reference[row] == reference
        here = start.rig_from_world[seen.frame[reference]]
        # points of the plane that project to the reference's square, by Newton's steps
        across = np.linalg.svd(normal[None])[2][1:]
        at = np.zeros((len(samples), 2))
        wanted = seen.pixels[reference] + step * samples
        for _ in range(20):
            now = project(CAMERA, here @ (point + at @ across))
            slope = np.stack(
                [(project(CAMERA, here @ (point + (at + d) @ across)) - now) / 1e-6
                 for d in 1e-6 * np.eye(2)], -1)  # fmt: skip
            at += np.linalg.solve(slope, (wanted - now)[..., None])[..., 0]
        there = project(CAMERA, start.rig_from_world[seen.frame[row]] @ (point + at @ across))
        ours = warps.middle[row] + monomials(*samples.T) @ warps.coefficients[row].T
        np.testing.assert_allclose(ours, there, atol=0.01)
        checked += 1
    assert checked > 50


# ---- matching -------------------------------------------------------------------------------


def test_patches_come_to_lie_where_the_walls_are(tmp_path: Path) -> None:
    """Without noise; the keypoints start half a pixel off, and pixels are read between pixels."""
    one = drawn(noise=0.0)
    found = matched(one, tmp_path)
    assert typical(errors(one, found)) < 0.01  # of a start of 0.4 px
    assert (
        is_good(found, one.true.observations.point).mean() > 0.98
        and (found.likeness > 0.98).mean() > 0.95
    )


def test_the_stated_covariance_is_that_of_the_errors(tmp_path: Path) -> None:
    """Squared errors over the covariance, one a degree of freedom, and by direction too."""
    one = drawn(noise=4.0)
    found = matched(one, tmp_path)
    nees = np.nanmedian(nees_of(one, found), axis=0)
    assert (nees > 0.75).all() and (nees < 1.4).all()
    assert 0.03 < typical(errors(one, found) / np.sqrt(left(one))[:, None]) < 0.06


@pytest.mark.parametrize(("scale", "finest_m"), [(1.5, 0.12), (3.0, 0.12), (6.0, 0.2)])
def test_covariances_hold_in_every_level_of_the_pyramid(
    tmp_path: Path, back_wall: None, scale: float, finest_m: float
) -> None:
    one = scene(noise=4.0, scale=scale, walls=Walls.drawn(0, finest_m))
    nees = np.nanmedian(nees_of(one, matched(one, tmp_path)), axis=0)
    assert (nees > 0.55).all() and (nees < 1.5).all()


def test_what_is_seen_from_afar_is_not_known_the_better_for_it(
    tmp_path: Path, back_wall: None
) -> None:
    """Its samples share pixels: counted as so many, they would say six times what they do."""
    one = scene(noise=4.0, walls=Walls.drawn(0, 0.2), far=True)
    found = matched(one, tmp_path)
    closer = one.true.observations.frame % 2 == 0
    nees = nees_of(one, found)
    for rows in (closer, ~closer):
        assert 0.5 < np.nanmedian(nees[rows]) < 2.6


def test_short_tracks_of_fine_texture_are_matched(tmp_path: Path) -> None:
    """Three views, which move at once, and waves of less than three pixels."""
    whole = scene(noise=2.0, keypoint_px=0.4, walls=Walls.drawn(0, 0.04))
    one = of_first(whole, 3)
    off = np.linalg.norm(errors(one, matched(one, tmp_path)), axis=1)
    assert np.median(off) < 0.02 and np.quantile(off, 0.9) < 0.06  # from 0.4


def test_brightness_does_not_matter(tmp_path: Path) -> None:
    one = drawn(noise=0.0)
    changed = [
        np.clip(gain * image + bias, 0, 255).astype(np.uint8)
        for image, gain, bias in zip(
            one.images, (0.5, 0.8, 1.0, 0.6, 0.9, 0.7), (30, 0, 5, 60, 20, 10), strict=True
        )
    ]
    found = matched(one, tmp_path, changed)
    assert typical(errors(one, found)) < 0.012


def test_stripes_are_uncertain_along_themselves(tmp_path: Path) -> None:
    """Waves that all but run one way: across them a patch is sharp, along them it is not."""
    room = Walls.drawn()
    flat = room.waves * np.array([1.0, 0.15, 0.15])
    one = scene(walls=replace(room, waves=flat), noise=2.0, n_points=60)
    found = matched(one, tmp_path)
    on_back = np.linalg.norm(found.fitted - np.eye(2), axis=(1, 2)) < 0.6
    size, directions = np.linalg.eigh(found.cov_px[on_back])
    assert np.median(size[:, 1] / size[:, 0]) > 9
    off = errors(one, found)[on_back]
    along = np.einsum("nij,ni->nj", directions, off)
    assert np.median(np.abs(along[:, 1])) > 2 * np.median(np.abs(along[:, 0]))


def test_what_stands_before_a_wall_is_seen_not_to_belong(tmp_path: Path) -> None:
    """One image shows something else on its left; the others agree as before."""
    one = drawn()
    hidden = [image.copy() for image in one.images]
    leaves = cv2.GaussianBlur(np.random.default_rng(9).normal(128, 300, (240, 160)), (0, 0), 2.0)
    hidden[2][:, :160] = np.clip(leaves, 0, 255)
    found = matched(one, tmp_path, hidden)
    seen = one.true.observations
    good = is_good(found, seen.point)
    covered = (seen.frame == 2) & (seen.pixels[:, 0] < 145)
    assert covered.sum() > 20
    assert good[covered].mean() < 0.15
    others = np.isin(seen.point, seen.point[covered]) & (seen.frame != 2)
    assert good[others].mean() > 0.95
    assert typical(errors(one, found, good & ~covered)[others & good]) < 0.03


def test_coarse_keypoints_are_matched_in_smaller_images(tmp_path: Path) -> None:
    one = drawn(scale=6.0, keypoint_px=1.0)
    warps = warps_of(one.true.initial, one.true.observations, one.true.observations.pixels)
    paths = [tmp_path / "0.png"]
    cv2.imwrite(str(paths[0]), one.images[0])
    crops = cut_out(Images(paths), np.zeros(3, np.int64), warps.subset(np.arange(3)))
    assert (crops.px == 4).all()
    found = matched(one, tmp_path)
    shown = found.likeness > 0.8
    assert shown.mean() > 0.7  # the walls' corners bend the rest
    assert np.median(np.abs(errors(one, found)[shown])) < 0.1


def test_a_patch_over_the_border_is_matched_by_what_is_there(tmp_path: Path) -> None:
    one = scene(n_points=450, seed=3)
    beyond = np.array(CAMERA.size) - 1 - one.true.observations.pixels
    at_border = (np.minimum(one.true.observations.pixels, beyond) < 7).any(1)
    found = matched(one, tmp_path)
    assert at_border.sum() > 5
    off = np.linalg.norm(errors(one, found)[at_border], axis=1)
    assert np.median(off) < 0.05 and np.quantile(off, 0.9) < 0.12


def test_batches_and_threads_change_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = drawn()
    whole, again = matched(one, tmp_path), matched(one, tmp_path)
    np.testing.assert_array_equal(whole.pixels, again.pixels)
    monkeypatch.setitem(match.A_BATCH, "cpu", 100)
    parts = matched(one, tmp_path)
    np.testing.assert_allclose(whole.pixels, parts.pixels, atol=2e-3)
    np.testing.assert_allclose(whole.likeness, parts.likeness, atol=1e-3)


def test_images_beyond_the_memory_are_read_again(tmp_path: Path) -> None:
    paths = [tmp_path / f"{i}.png" for i in range(4)]
    for index, path in enumerate(paths):
        cv2.imwrite(str(path), np.full((64, 64), 40 * index, np.uint8))
    images = Images(paths, most_bytes=60_000)  # two pyramids of 64 x 64
    for number in (0, 1, 2, 3, 0, 3, 1):
        assert images.pyramid(number)[0][MARGIN, MARGIN] == 40 * number
        assert images.bytes_kept <= 60_000
    paths[2].write_bytes(b"")
    with pytest.raises(CalibrationError, match=r"2\.png can no longer be read"):
        images.pyramid(2)
