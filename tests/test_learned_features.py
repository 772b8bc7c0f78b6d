"""Features of networks: kornia's own, placed finer, in pixels whose centres are whole numbers."""

import importlib.util
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from synthetic.networks import blobs, import_or_skip, random_weights

from sfm_calib.errors import CalibrationError
from sfm_calib.learned import extract, networks
from sfm_calib.learned.extract import LearnedFeatures, features_of, in_full, load, save, shrunk
from sfm_calib.learned.networks import STRIDE, Detector, Maps, build_detector, detect, refined
from sfm_calib.learned.weights import FEATURES

torch, kornia = import_or_skip()


def tensor_of(image):
    return torch.from_numpy(image).permute(2, 0, 1).float() / 255


def brightness(both_ways=False, lean=(0, 0)):
    """A network whose features are bright blobs, and lie `lean` px right of and below them."""

    def maps(image):
        assert image.shape[2] % STRIDE == 0 and image.shape[3] % STRIDE == 0
        peaks = (image.mean(1)[0] + 1e-3).log().roll((lean[1], lean[0]), (0, 1))
        peaks = peaks + 1e-5 * (torch.arange(peaks.numel()) % 7).view(peaks.shape)  # no two alike
        return Maps(peaks, peaks, lambda pixels: pixels.new_ones((len(pixels), 4)) / 2)

    return Detector(maps, math.log(0.4), both_ways, 4, Path("made-up.pth"))


def off(found, known):
    """From each known place (n, 2) to the nearest found (m, 2)."""
    apart = found[:, None] - known[None]
    nearest = np.linalg.norm(apart, axis=2).argmin(0)
    return found[nearest] - known


@pytest.mark.parametrize(
    ("size", "longest", "sigma"),
    [
        ((320, 224), 400, 2.0),
        ((301, 213), 400, 2.0),
        ((640, 416), 320, 4.0),
        ((701, 467), 250, 6.0),
    ],
    ids=["as it is", "padded", "halved", "shrunk by 2.804"],
)
def test_pixel_centres_are_whole_numbers_whatever_the_network_sees(size, longest, sigma):
    """Half a pixel off would be COLMAP's origin, or corners taken for centres when shrunk."""
    image, known = blobs(size, sigma)
    found = features_of(image, brightness(), longest, "cpu", 1000)
    assert len(found) == len(known)
    apart = off(found.pixels, known)
    scale = max(1.0, max(size) / longest)
    assert np.abs(apart.mean(0)).max() < 0.01 * scale and np.abs(apart).max() < 0.05 * scale


def test_shrinking_keeps_corners_on_corners():
    image = np.zeros((467, 701, 3), np.uint8)
    seen = shrunk(image, 250)
    height, width = seen.shape[:2]
    assert (width, height) == (250, 167) and shrunk(image, 701) is image
    ends = np.array([[-0.5, -0.5], [width - 0.5, height - 0.5]])
    np.testing.assert_allclose(in_full(ends, seen, image), [[-0.5, -0.5], [700.5, 466.5]])


def test_half_a_turn_undoes_what_a_network_leans_and_so_does_knowing_it():
    image, known = blobs((301, 213), 2.0)
    leaning = features_of(image, brightness(lean=(1, 0)), 400, "cpu", 1000)
    np.testing.assert_allclose(off(leaning.pixels, known).mean(0), [1, 0], atol=0.02)
    known_lean = replace(brightness(lean=(1, 0)), lean_px=(1.0, 0.0))
    without = features_of(image, known_lean, 400, "cpu", 1000)
    np.testing.assert_allclose(off(without.pixels, known).mean(0), 0, atol=0.02)
    both = features_of(image, brightness(True, lean=(1, 0)), 400, "cpu", 1000)
    assert len(both) == len(known)
    np.testing.assert_allclose(off(both.pixels, known).mean(0), 0, atol=0.02)


def test_weights_that_see_nothing_again_upside_down_are_refused():
    image, _ = blobs((480, 480), 2.0)
    with pytest.raises(
        CalibrationError, match=r"made-up.pth: of \d+ features .* only \d+ are left"
    ):
        features_of(image, brightness(True, lean=(9, 0)), 480, "cpu", 1000)


def test_a_maximum_is_found_between_pixels():
    y, x = torch.meshgrid(torch.arange(9.0), torch.arange(9.0), indexing="ij")
    tilted = -((x - 4.3) ** 2) - 2 * (y - 3.8) ** 2 + (x - 4.3) * (y - 3.8)
    whole = torch.tensor([[4, 4]])
    torch.testing.assert_close(refined(tilted, whole), torch.tensor([[4.3, 3.8]]))
    saddle = -((x - 4) ** 2) - (y - 4) ** 2 + 4 * (x - 4) * (y - 4)
    torch.testing.assert_close(refined(saddle, whole), torch.tensor([[4.0, 4.0]]))


def kornias_own(name, path, image):
    """Whole pixels (n, 2) and descriptors of kornia's own detection."""
    weights = torch.load(path, weights_only=True)
    with torch.inference_mode():
        if name == "xfeat":
            network = kornia.XFeat(top_k=500)
            network.net.load_state_dict(weights)
            found = network.eval().detectAndCompute(image[None])[0]
            return found["keypoints"], found["descriptors"]
        if name == "disk":
            network = kornia.DISK()
            network.load_state_dict(weights["extractor"])
            found = network.eval()(image[None], n=500)[0]
        else:
            network = kornia.ALIKED("aliked-n16rot")
            network.load_state_dict(weights, strict=False)
            network.eval().dkd.forward = whole_pixels(network.dkd.forward)
            found = network(image[None])[0]
        return found.keypoints, found.descriptors


def whole_pixels(forward):
    return lambda scores, image_size: forward(scores, False, image_size)


@pytest.mark.parametrize("name", ["xfeat", "aliked", "disk"])
def test_features_are_kornias_own(name, tmp_path, monkeypatch):
    """But for where they are between pixels, on which descriptors depend too, and XFeat's cells."""
    monkeypatch.setattr(networks, "CELL_STEP", networks.CELL)
    path = random_weights(name, tmp_path)
    detector = replace(build_detector(name, path, "cpu"), both_ways=False, lean_px=(0, 0))
    image = torch.rand(3, 96, 128, generator=torch.Generator().manual_seed(1))
    monkeypatch.setattr(networks, "refined", lambda peaks, whole: whole.float())
    pixels, descriptors = detect(detector, image, 500)
    theirs, described = kornias_own(name, path, image)
    ours = {tuple(p): d for p, d in zip(pixels.round().int().tolist(), descriptors, strict=True)}
    others = {tuple(p): d for p, d in zip(theirs.round().int().tolist(), described, strict=True)}
    assert len(others) > 20
    common = ours.keys() & others.keys()
    assert len(common) >= 0.98 * max(len(ours), len(others))
    assert descriptors.shape[1] == detector.width
    for place in common:
        torch.testing.assert_close(ours[place], others[place], atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize("name", ["xfeat", "aliked", "disk"])
def test_the_same_every_time_and_none_of_a_small_blank(name, tmp_path):
    detector = build_detector(name, random_weights(name, tmp_path), "cpu")
    detector = replace(detector, threshold=-20.0)
    image, _ = blobs((90, 70), 2.0)
    first, again = (features_of(image, detector, 90, "cpu", 30) for _ in range(2))
    np.testing.assert_array_equal(first.pixels, again.pixels)
    np.testing.assert_array_equal(first.descriptors, again.descriptors)
    assert 0 < len(first) <= 30 and first.descriptors.dtype == np.float32
    none = replace(detector, threshold=math.inf)
    assert features_of(image, none, 90, "cpu", 30).descriptors.shape == (0, detector.width)


def test_features_are_loaded_as_they_were_saved(tmp_path):
    (tmp_path / extract.FOLDER).mkdir()
    rng = np.random.default_rng(0)
    found = LearnedFeatures(rng.uniform(0, 9, (5, 2)), rng.normal(size=(5, 8)).astype(np.float32))
    save(found, tmp_path, 3)
    again = load(tmp_path, 3)
    np.testing.assert_array_equal(again.pixels, found.pixels)
    np.testing.assert_array_equal(again.descriptors, found.descriptors)
    assert len(again.strongest(2)) == 2


def test_a_gpu_that_is_not_there_is_one_line(monkeypatch, tmp_path):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(CalibrationError, match=r"device cuda: torch finds no GPU .* leave --"):
        build_detector("disk", tmp_path / "disk.pth", "cuda")


def installed(name):
    """The published weights of these features, where their package is installed."""
    package, _, folder = FEATURES[name].folder.partition("/")
    spec = importlib.util.find_spec(package)
    if spec is None:
        pytest.skip(f"{FEATURES[name].package} is not installed: make weights")
    return Path(spec.submodule_search_locations[0]) / folder / FEATURES[name].files[0]


@pytest.mark.parametrize(("step", "same"), [(8, False), (2, True)], ids=["kornia's", "ours"])
def test_where_xfeats_cells_begin_matters_no_more(step, same, tmp_path, monkeypatch):
    monkeypatch.setattr(networks, "CELL_STEP", step)
    detector = build_detector("xfeat", random_weights("xfeat", tmp_path), "cpu")
    image = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(1))
    with torch.inference_mode():
        before, after = detector.maps(image).peaks, detector.maps(image.roll((2, 4), (2, 3))).peaks
    inner = slice(16, -16)
    close = torch.isclose(
        after.roll((-2, -4), (0, 1))[inner, inner], before[inner, inner], atol=1e-4
    )
    assert bool(close.all()) is same


@pytest.mark.slow
def test_published_weights_of_aliked_do_not_lean():
    """Against itself, turned by 8 degrees: half a pixel of convention would show as (0.5, 0.5)."""
    detector = build_detector("aliked", installed("aliked"), "cpu")
    rng = np.random.default_rng(0)
    scene = sum(
        cv2.resize(rng.uniform(0, 1, (n, n, 3)), (1536, 1536), interpolation=cv2.INTER_NEAREST)
        for n in (12, 24, 48)
    )
    scene = cv2.GaussianBlur((85 * scene).astype(np.uint8), (0, 0), 2.5)
    turn = np.vstack([cv2.getRotationMatrix2D((191.5, 191.5), 8, 1), [0, 0, 1]])
    larger = np.array([[4, 0, 1.5], [0, 4, 1.5], [0, 0, 1]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    a, b = (
        features_of(
            cv2.warpPerspective(scene, m, (384, 384), flags=flags), detector, 384, "cpu", 800
        )
        for m in (larger, larger @ np.linalg.inv(turn))
    )
    there = a.pixels @ turn[:2, :2].T + turn[:2, 2]
    apart = b.pixels[None] - there[:, None]
    near = np.linalg.norm(apart, axis=2)
    mutual = (near.argmin(0)[near.argmin(1)] == np.arange(len(a))) & (near.min(1) < 2)
    differ = apart[np.arange(len(a)), near.argmin(1)][mutual]
    assert len(differ) > 100
    lean = np.linalg.solve(np.eye(2) - turn[:2, :2], differ.mean(0))
    assert np.abs(lean).max() < 0.3
