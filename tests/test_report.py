"""The report is one whole file that needs nothing else and survives what it is given."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from graphs.camera import Camera, project
from graphs.frames import Transform
from graphs.problem import Estimate, Observations, Problem, points_in_cameras, residuals_px
from sfm_calib.errors import CalibrationError
from sfm_calib.provenance import Provenance
from sfm_calib.report.correlation import correlation_matrix, strongest_pairs
from sfm_calib.report.image_plane import cell_counts, cell_means, noise_of_cell_mean
from sfm_calib.report.page import write_report
from sfm_calib.report.residuals import radial_profile, residuals_by_camera
from sfm_calib.report.rows import TruthRow, baseline_sigma, camera_tables, quantity, rig_tables
from sfm_calib.report.scene import central, frustum
from sfm_calib.report.theme import evenly, round_number
from sfm_calib.result import (
    Calibration,
    Covariance,
    Noise,
    Scale,
    Solve,
    Verdict,
    WeakDirection,
    truth,
)

SIGMA_PX = 0.4
N_FRAMES, N_POINTS = 10, 200
VERDICT = Verdict(
    usable=True,
    weak=(WeakDirection(what="cx against p2", effect_px=1.3, remedy="roll the rig by 90 deg"),),
    messages=("3 mismatched <b>images</b> were left out",),
)
SOLVE = Solve(
    converged=True,
    reason="relative decrease below 1e-8",
    iterations=9,
    rms_px=0.61,
    n_frames=10,
    n_images=20,
    n_points=200,
    n_observations=3210,
    seconds={"features": 12.3, "matching": 20.1, "mapping": 8.8, "solve": 3.4},
)
PROVENANCE = Provenance(
    version="0.1.0",
    versions={"gtsam": "4.3"},
    command="sfm-calib calibrate scan -o out",
    config={"lens": "radtan"},
    input_hashes={"left/0.png": "ab12"},
)
SAID = ("decided mostly by the prior", "roll the rig by 90 deg", "× 1.80", "a known baseline")
SAID += ("baseline length", "20.10 s", "left/0.png", "OpenCV: the centre of the top-left pixel")
LOADS = {"src", "srcset", "data", "poster", "action", "formaction", "background"}


def scene(
    names: tuple[str, ...],
    rng: np.random.Generator,
    n_frames: int = N_FRAMES,
    n_points: int = N_POINTS,
) -> tuple[Problem, Estimate]:
    """A rig that walks past a wall of points, seen with SIGMA_PX of noise."""
    params = np.array([500.0, 502.0, 322.0, 238.0, -0.2, 0.03, 0.001, -0.0005])
    cameras = tuple(Camera(name, "radtan", (640, 480), params) for name in names)
    cam_from_rig = tuple(
        Transform.exp(np.array([0.0, 0.05 * k, 0.01 * k]), np.array([-0.3 * k, 0.0, 0.0]))
        for k in range(len(names))
    )
    rig_from_world = tuple(
        Transform.exp(
            rng.normal(0, 0.04, 3), np.array([0.25 * (n_frames / 2 - k), 0.1 * np.sin(k), 0.0])
        )
        for k in range(n_frames)
    )
    points = np.column_stack(
        [rng.uniform(-4, 4, n_points), rng.uniform(-2, 2, n_points), rng.uniform(3, 6, n_points)]
    )
    estimate = Estimate(cameras, cam_from_rig, rig_from_world, points)
    frame, camera, point = (
        index.ravel()
        for index in np.meshgrid(np.arange(n_frames), np.arange(len(names)), np.arange(n_points))
    )
    everything = Observations(np.zeros((len(frame), 2)), frame, camera, point)
    pixels = np.full((len(frame), 2), np.nan)
    for index, one in enumerate(cameras):
        rows = camera == index
        pixels[rows] = project(one, points_in_cameras(estimate, everything)[rows])
    seen = ((pixels > 0) & (pixels < [639, 479])).all(axis=1)
    pixels = pixels + rng.normal(0, SIGMA_PX, pixels.shape)
    observations = Observations(pixels, frame, camera, point).subset(seen)
    frame_names = tuple(f"frame_{k:03d}" for k in range(n_frames))
    return Problem(estimate, observations, frame_names), estimate


def covariance_of(estimate: Estimate, rng: np.random.Generator) -> Covariance:
    names = [f"{c.name}.{p}" for c in estimate.cameras for p in c.names]
    kinds = [f"{kind}_{axis}" for kind in ("rotation", "translation") for axis in "xyz"]
    names += [f"{c.name}.{kind}" for c in estimate.cameras[1:] for kind in kinds]
    root = rng.normal(size=(len(names), 12)) * 1e-2
    return Covariance(names=tuple(names), matrix=(root @ root.T).tolist())


def calibration_of(problem: Problem, estimate: Estimate, rng: np.random.Generator) -> Calibration:
    """A result that says about the scene what a real one would."""
    cov = covariance_of(estimate, rng)
    sigma = dict(zip(cov.names, np.sqrt(np.diag(cov.matrix)).tolist(), strict=True))
    exact = truth(list(estimate.cameras), list(estimate.cam_from_rig), "0.1.0")
    cameras = {
        name: entry.model_copy(
            update={
                "sigma": {p: sigma[f"{name}.{p}"] for p in entry.params},
                "prior_share": {"cx": 0.72, "cy": 0.08},
                "n_images": len(problem.frame_names),
            }
        )
        for name, entry in exact.cameras.items()
    }
    poses = {
        name: entry.model_copy(
            update={
                "sigma_rotation_deg": [sigma.get(f"{name}.rotation_{a}", 0.0) for a in "xyz"],
                "sigma_translation": [sigma.get(f"{name}.translation_{a}", 0.0) for a in "xyz"],
            }
        )
        for name, entry in exact.rig.cam_from_rig.items()
    }
    scale = Scale(source="a known baseline", sigma_relative=0.002)
    rig = exact.rig.model_copy(update={"cam_from_rig": poses, "scale": scale})
    noise = Noise(sigma_px=SIGMA_PX, inflation=1.8)
    told = {"covariance": cov, "noise": noise, "verdict": VERDICT, "solve": SOLVE}
    return exact.model_copy(
        update={"cameras": cameras, "rig": rig, "provenance": PROVENANCE, **told}
    )


Case = tuple[Calibration, Problem, Estimate]


@pytest.fixture(scope="module")
def stereo() -> Case:
    rng = np.random.default_rng(0)
    problem, estimate = scene(("left", "<script>alert(1)</script>"), rng)
    return calibration_of(problem, estimate, rng), problem, estimate


@pytest.fixture(scope="module")
def mono() -> Case:
    rng = np.random.default_rng(1)
    problem, estimate = scene(("only",), rng)
    return calibration_of(problem, estimate, rng), problem, estimate


def written(
    case: Case, folder: Path, truth_rows: tuple[TruthRow, ...] = (), title: str = "Report"
) -> str:
    path = folder / "report.html"
    write_report(*case, path, truth_rows, title)
    return path.read_text()


@pytest.fixture(scope="module")
def stereo_page(stereo: Case, tmp_path_factory: pytest.TempPathFactory) -> str:
    rows = (
        TruthRow("left.fx", 500.0, 499.0, 1.0, 0.2, 5.0),
        TruthRow("left.fy", 502.0, 502.1, -0.1, 0.2, -0.5),
        TruthRow("focal ratio", 1.0, 1.01, -0.01, 0.01, -1.0),
        TruthRow("left.k1", -0.2, -0.2, 0.0, 0.0, float("nan")),
    )
    folder = tmp_path_factory.mktemp("stereo")
    return written(stereo, folder, rows, "Scan & <i>title</i>")


class Page(HTMLParser):
    """What a browser would see as elements."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.inside = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self.inside = tag if tag in ("script", "style") else ""

    def handle_endtag(self, tag: str) -> None:
        if tag in ("script", "style"):
            self.inside = ""

    def handle_data(self, data: str) -> None:
        if not self.inside:
            self.text += data


def test_page_loads_nothing(stereo_page: str) -> None:
    page = Page(stereo_page)
    for tag, attributes in page.tags:
        assert tag not in ("link", "iframe", "img", "object", "embed", "base")
        assert not LOADS & attributes.keys()
        assert (attributes.get("href") or "#").startswith("#")
    styles = re.findall(r"<style>.*?</style>", stereo_page, re.DOTALL)
    assert styles and not any("url(" in s or "@import" in s for s in styles)
    assert "default-src 'none'" in stereo_page
    assert stereo_page.count("plotly.js v") == 1
    figures = stereo_page.count("Plotly.newPlot(")
    assert stereo_page.count('"showSendToCloud": false') == figures > 10
    assert '"plotlyServerURL"' not in stereo_page
    assert len(stereo_page) < 10e6


def test_page_names_every_parameter_and_figure(stereo: Case, stereo_page: str) -> None:
    page, calibration = Page(stereo_page), stereo[0]
    titles = {a["title"] for tag, a in page.tags if "title" in a}
    assert set(calibration.covariance.names) <= titles
    keys = {a["id"] for _, a in page.tags if "id" in a}
    shown = ("single", "shared", "coverage", "size", "radius", "frames")
    panels = {f"camera-{k}-{panel}" for k in (0, 1) for panel in shown}
    assert panels | {"heat", "rig-3d", "scan-3d", "truth-z", "camera-1-sigma-rig"} <= keys
    assert all(words in page.text for words in SAID)
    assert "frame_003" in stereo_page
    assert set(re.findall(r'href="#(\w+)"', stereo_page)) <= keys


def test_outside_text_is_escaped(stereo_page: str) -> None:
    page = Page(stereo_page)
    assert "<script>alert" not in stereo_page
    assert "<script>alert(1)</script>" in page.text
    assert "<i>title</i>" in page.text and "<b>images</b>" in page.text
    # Inside plotly's JSON the name must stay escaped after the JSON is read, too.
    assert "\\u003cscript" not in stereo_page
    assert "&lt;script" in stereo_page


def test_truth_columns_mark_what_is_beyond_four_sigma(stereo_page: str) -> None:
    assert stereo_page.count('class="alarm"') == 1
    assert "Further quantities" in stereo_page
    assert "The largest is left.fx with z = +5.0" in Page(stereo_page).text


def test_mono_has_no_rig_section(mono: Case, tmp_path: Path) -> None:
    text = written(mono, tmp_path)
    assert 'id="rig"' not in text and 'id="rig-3d"' not in text and 'id="truth"' not in text
    assert 'id="scan-3d"' in text and 'id="camera-0-sigma-camera"' in text
    assert 'id="camera-0-sigma-rig"' not in text and "Of depths" not in text


def test_same_input_same_page(mono: Case, tmp_path: Path) -> None:
    assert written(mono, tmp_path) == written(mono, tmp_path)


def test_bare_calibration_is_enough(stereo: Case, tmp_path: Path) -> None:
    _, problem, estimate = stereo
    bare = truth(list(estimate.cameras), list(estimate.cam_from_rig), "")
    rig = bare.rig.model_copy(update={"metric": False, "scale": Scale(source="baselines")})
    text = written((bare.model_copy(update={"rig": rig}), problem, estimate), tmp_path)
    said = ("Not judged", "not metric", "states no covariance", "not estimated")
    assert all(words in text for words in said)


def test_unprojectable_points_are_counted_not_drawn(mono: Case, tmp_path: Path) -> None:
    calibration, problem, estimate = mono
    points = estimate.points.copy()
    points[:5, 2] = -3.0
    points[5] = np.nan
    moved = replace(estimate, points=points)
    lost = int(np.isnan(residuals_px(moved, problem.observations)[:, 0]).sum())
    assert lost > 0
    text = written((calibration, problem, moved), tmp_path)
    assert f"{lost:,} more point(s) cannot be projected" in text


def test_no_observation_at_all(mono: Case, tmp_path: Path) -> None:
    calibration, problem, estimate = mono
    nothing = problem.observations.subset(np.zeros(len(problem.observations), bool))
    text = written((calibration, replace(problem, observations=nothing), estimate), tmp_path)
    assert "No observation of this camera could be projected." in text


@pytest.mark.parametrize("sigma_px", [None, 0.0, 0.4])
def test_perfect_data(mono: Case, tmp_path: Path, sigma_px: float | None) -> None:
    calibration, problem, estimate = mono
    residuals = residuals_px(estimate, problem.observations)
    exact = replace(problem.observations, pixels=problem.observations.pixels + residuals)
    noise = None if sigma_px is None else Noise(sigma_px=sigma_px)
    case = (calibration.model_copy(update={"noise": noise}), replace(problem, observations=exact))
    assert 'id="camera-0-shared"' in written((*case, estimate), tmp_path)


def test_full_disk_leaves_nothing(
    mono: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(CalibrationError, match="No space left"):
        written(mono, tmp_path)
    assert not list(tmp_path.iterdir())


def test_file_names_that_are_not_utf8(mono: Case, tmp_path: Path) -> None:
    calibration, problem, estimate = mono
    named = replace(problem, frame_names=("bad\udcff", *problem.frame_names[1:]))
    message = Verdict(usable=False, messages=("skipped bad\udcff.png",))
    odd = calibration.model_copy(update={"verdict": message})
    assert "skipped bad?.png" in written((odd, named, estimate), tmp_path)


@pytest.mark.parametrize(
    ("value", "sigma", "shown"),
    [
        (690.123456, 0.234, ("690.12", "0.23")),
        (-0.00123456, 0.0000321, ("-0.001235", "0.000032")),
        (1.0, 0.0, ("1", "held fixed")),
        (1.25, None, ("1.25", "not estimated")),
        (1.25, float("nan"), ("1.25", "unknown")),
    ],
)
def test_digits_follow_sigma(value: float, sigma: float | None, shown: tuple[str, str]) -> None:
    row = quantity("cam.x", "x", value, sigma, "", {})
    assert (row.value, row.sigma) == shown


def test_tables_hold_every_parameter(stereo: Case) -> None:
    calibration = stereo[0]
    lenses, rig = camera_tables(calibration), rig_tables(calibration)
    assert [row.label for row in lenses[0].rows] == list(calibration.cameras["left"].params)
    assert lenses[0].rows[2].prior_decides and not lenses[0].rows[3].prior_decides
    assert len(rig) == 1 and len(rig[0].rows) == 7


def test_baseline_sigma_uses_the_covariance(stereo: Case) -> None:
    calibration = stereo[0]
    name = "<script>alert(1)</script>"
    index = calibration.covariance.names.index(f"{name}.translation_x")
    # The translation lies along x here, so the baseline's sigma is that of its x.
    variance = calibration.covariance.matrix[index][index]
    assert baseline_sigma(calibration, name) ** 2 == pytest.approx(variance)


def test_correlations_of_a_known_matrix() -> None:
    cov = Covariance(
        names=("a.x", "a.y", "a.z"), matrix=((4.0, -5.7, 0.0), (-5.7, 9.0, 0.0), (0, 0, 0))
    )
    matrix = correlation_matrix(cov)
    assert matrix[0, 1] == pytest.approx(-0.95)
    assert np.isnan(matrix[2]).all()
    assert [(p.first, p.second) for p in strongest_pairs(cov)] == [("a.x", "a.y")]


def test_distortion_error_shows_in_the_radial_profile(mono: Case) -> None:
    _, problem, estimate = mono
    wrong = estimate.cameras[0].params.copy()
    wrong[4] += 0.02
    bent = replace(estimate, cameras=(replace(estimate.cameras[0], params=wrong),))
    (good,), (bad,) = (residuals_by_camera(problem, e, SIGMA_PX) for e in (estimate, bent))
    for part, bent_outward in ((good, False), (bad, True)):
        _, means, errors = radial_profile(part)
        assert (means[-1, 0] > 5 * errors[-1, 0]) == bent_outward


def test_cells_hold_every_inlier_and_average_out(mono: Case) -> None:
    (part,) = residuals_by_camera(mono[1], mono[2], SIGMA_PX)
    inside = ((part.pixels > -0.5) & (part.pixels < [639.5, 479.5])).all(axis=1)
    assert cell_counts(part.pixels, part.camera).sum() == inside.sum()
    means, _ = cell_means(part)
    expected = noise_of_cell_mean(part)
    assert expected == pytest.approx(np.nanmean(np.linalg.norm(means, axis=-1)), rel=0.2)


def test_far_points_do_not_ruin_the_view() -> None:
    rng = np.random.default_rng(3)
    points = np.concatenate([rng.normal(size=(980, 3)), rng.normal(size=(20, 3)) * 1e5])
    assert np.abs(central(points)).max() < 5


def test_round_numbers_and_even_samples() -> None:
    assert [round_number(v) for v in (0.99, 1.0, 4.9, 23.0, 730.0)] == [0.5, 1.0, 2.0, 20.0, 500.0]
    assert evenly(3, 10).tolist() == [0, 1, 2]
    assert evenly(0, 10).size == 0


@pytest.mark.parametrize("focal_px", [500.0, 150.0, 20.0])
def test_frustum_of_a_fisheye_opens_ahead(focal_px: float) -> None:
    params = np.array([focal_px, focal_px, 400.0, 300.0, -0.02, 0.003, 0.0, 0.0])
    camera = Camera("fisheye", "kannala_brandt", (800, 600), params)
    corners = frustum(camera, Transform.identity(), 2.0)[0]
    assert np.linalg.norm(corners, axis=1) == pytest.approx(2.0)
    assert (corners[:, 2] > 0.5).all()
