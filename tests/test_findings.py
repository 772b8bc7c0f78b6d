"""What a scan lacks is named, with its number and a remedy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_result import rig
from test_sharpness import quality

from graphs.coverage import GRID, coverage
from graphs.lenses import LensName
from sfm_calib.check import worst_of
from sfm_calib.coverage_findings import coverage_findings
from sfm_calib.findings import Finding, image_findings, solve_findings
from sfm_calib.images import Scan, ScanImage
from sfm_calib.result import Selection, Solve
from sfm_calib.sharpness import lit_cells
from sfm_calib.simulate.tracks import TrackOptions, simulate_tracks

# ---- images ------------------------------------------------------------------------------------


def scan_of(names=("camera",), frames=40):
    images = tuple(ScanImage(c, f, f"{c}/{f}") for c in range(len(names)) for f in range(frames))
    frame_names = tuple(f"{f:06d}" for f in range(frames))
    return Scan(Path("scan"), names, ((640, 480),) * len(names), frame_names, images)


def test_a_few_blurred_images_are_a_note_and_many_a_doubt():
    some = [quality(2.0 if frame < 2 else 0.3, frame=frame) for frame in range(40)]
    many = [quality(2.0, frame=frame) for frame in range(40)]
    (note,), (doubt,) = (image_findings(scan_of(), each) for each in (some, many))
    assert (note.severity, doubt.severity) == ("note", "doubtful")
    assert "2 of 40 images (000000, 000001)" in note.what and note.remedy
    assert doubt.what.endswith("000004 and 35 more)") and doubt.value == 1


def test_white_and_black_images():
    own = [quality(white=0.6 * (f % 2), black=0.7 * (f % 2 == 0), frame=f) for f in range(10)]
    white, black = image_findings(scan_of(), own)
    assert "white: 5 of 10 images (000001" in white.what and "shorter" in white.remedy
    assert "black: 5 of 10 images (000000" in black.what and "longer" in black.remedy


def test_the_dark_rim_of_a_fisheye_is_not_underexposed():
    cells = np.full((GRID, GRID), 100.0)
    cells[:3], cells[-3:] = 0, 0
    own = [replace(quality(black=0.6, frame=f), brightness=cells) for f in range(5)]
    assert image_findings(scan_of(), own) == []
    assert lit_cells(own, 0).sum() == GRID * (GRID - 6)


# ---- what the geometry lacks -------------------------------------------------------------------


def simulated(trajectory, rig_name, keep=None):
    """Coverage findings of simulated tracks, as {topic: severity}, and the findings."""
    lens: LensName = "radtan"
    options = TrackOptions(rig=rig_name, trajectory=trajectory, frames=40, points=3000, lens=lens)
    problem, true = simulate_tracks(options, np.random.default_rng(0))
    if keep is not None:
        seen = problem.observations
        problem = replace(problem, observations=seen.subset(keep(seen)))
    covered = coverage(replace(problem, initial=true), min_parallax_deg=1.0)
    names = tuple(camera.name for camera in covered.cameras)
    found = coverage_findings(scan_of(names), problem.frame_names, covered)
    return {each.topic: each.severity for each in found}, found


def test_a_handheld_walk_lacks_nothing():
    for rig_name in ("mono", "stereo"):
        assert simulated("handheld", rig_name)[1] == []


def test_a_corridor_lacks_turns_and_sideways_motion():
    topics, found = simulated("corridor", "stereo")
    assert set(topics) == {"roll", "tilt", "turn", "forward"}
    assert set(topics.values()) == {"doubtful"}
    assert all(each.remedy and each.camera in ("cam0", "cam1") for each in found)
    (forward,) = (each for each in found if (each.topic, each.camera) == ("forward", "cam0"))
    assert "99% of its way" in forward.what and forward.value == pytest.approx(0.99, abs=0.01)


@pytest.mark.parametrize("trajectory", ["panorama", "static"])
def test_a_camera_on_the_spot_lacks_parallax(trajectory):
    topics, found = simulated(trajectory, "mono")
    assert topics["parallax"] == "doubtful"
    assert any("turning on the spot is not enough" in each.remedy for each in found)


def test_an_empty_border_of_the_image():
    def middle(seen):
        return (np.abs(seen.pixels - [319.5, 239.5]) < 0.6 * np.array([320, 240])).all(1)

    topics, _ = simulated("handheld", "mono", middle)
    assert topics == {"coverage": "doubtful", "corners": "doubtful"}


def test_one_empty_corner_is_a_note():
    topics, found = simulated(
        "handheld", "mono", lambda seen: (seen.pixels[:, 0] > 128) | (seen.pixels[:, 1] > 96)
    )
    assert topics == {"corners": "note"} and "top left" in found[0].what


def test_few_images_and_lost_ones():
    topics, found = simulated("handheld", "mono", lambda seen: seen.frame < 8)
    assert topics["images"] == topics["placed"] == "doubtful"
    assert any("only 8 of its 40 images" in each.what for each in found)
    assert simulated("handheld", "mono", lambda seen: seen.frame < 15)[0]["images"] == "note"


def test_poor_images_are_named():
    def thinned(seen):
        return (seen.frame != 7) | (np.cumsum(seen.frame == 7) <= 20)

    topics, found = simulated("handheld", "mono", thinned)
    assert topics == {"texture": "note"} and "1 (000007)" in found[0].what


def test_cameras_that_share_nothing():
    def apart(seen):
        return seen.point % 2 == seen.camera

    topics, found = simulated("handheld", "stereo", apart)
    assert topics == {"overlap": "doubtful"} and "shares 0 points" in found[0].what


# ---- what a quick solve says -------------------------------------------------------------------


def solved(fx=0.5, cx=0.5, turn_deg=0.02, converged=True, factor=None):
    """A result of two cameras with these sigmas."""
    sigma = {"fx": fx, "fy": fx, "cx": cx, "cy": cx}
    calibration = rig()
    cameras = {
        name: camera.model_copy(update={"sigma": sigma})
        for name, camera in calibration.cameras.items()
    }
    mounts = {
        name: mount.model_copy(update={"sigma_rotation_deg": (turn_deg, 0.0, 0.0)})
        for name, mount in calibration.rig.cam_from_rig.items()
    }
    chosen = factor and Selection(
        available=2, kept=1, sigma_factor=factor, worst_sigma_factor=factor
    )
    solve = Solve.model_construct(converged=converged, reason="steps ran out", selection=chosen)
    return calibration.model_copy(
        update={
            "cameras": cameras,
            "rig": calibration.rig.model_copy(update={"cam_from_rig": mounts}),
            "solve": solve,
        }
    )


@pytest.mark.parametrize(
    ("sigmas", "expected"),
    [
        ({}, set()),
        ({"fx": 3.0}, {("focal length", "doubtful")}),
        ({"fx": 15.0}, {("focal length", "cannot")}),
        ({"fx": 15.0, "factor": 2.0}, {("focal length", "doubtful")}),  # all would say enough
        ({"cx": 3.0}, {("principal point", "doubtful")}),
        ({"turn_deg": 0.3}, {("mount", "doubtful")}),
        ({"converged": False}, {("solve", "cannot")}),
    ],
)
def test_wide_sigmas(sigmas, expected):
    found = solve_findings(solved(**sigmas))
    assert {(each.topic, each.severity) for each in found} == expected
    assert all(each.remedy for each in found)


def test_the_worst_finding_is_the_verdict():
    findings = [
        Finding(camera="a", severity=severity, topic="", what="")
        for severity in ("note", "doubtful", "cannot")
    ]
    verdicts = [worst_of(findings[:count]) for count in range(4)]
    assert verdicts == ["good", "good", "doubtful", "cannot"]
