"""What is wrong with a scan's images, and what a quick solve says of it: rules and remedies.

What the geometry says is in `sfm_calib.coverage_findings`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np

from graphs.usable import USABLE_FOCAL_SIGMA
from sfm_calib.images import Scan
from sfm_calib.record import Record
from sfm_calib.result import Calibration, CameraResult
from sfm_calib.sharpness import ImageQuality, dark_share

Severity = Literal["note", "doubtful", "cannot"]

# ---- images ---------------------------------------------------------------------------------

# Sigma of the sharpest edges, images at 1 MP. All 229 real images: 0.0 to 0.74. Blurred by 2 px or
# smeared over 10 px they measure 1.1 to 2.8, and SIFT finds a quarter of its features (11 to 29 %);
# blurred by 1 px 0.6 to 1.3, and it finds 40 to 134 %.
BLURRED_PX = 1.2
# One image among sharp ones: smeared over 5 px, 39 to 77 % of the features left, they measure 0.65
# to 1.8; in no real scan is an image wider than its camera's median by more than 0.5.
BLURRED_BESIDE_PX, WIDER_THAN_OTHERS_PX = 0.9, 0.6
MOST_BLURRED = 0.2  # of a camera's images: a few always are, a hasty walk's all
MOST_WHITE = 0.35  # of the pixels. Real scans: 0.21 at most, street with its sky 0.14
MOST_BLACK = 0.5  # of the pixels that the lens lights. Real scans: 0.02 at most

# ---- what a quick solve states --------------------------------------------------------------

# Corridor 0.44 % (2 % off in truth), street 0.5 %, simulated corridors 0.37 to 0.7 % (0.4 to 1 %
# off); fountain 0.07 %, simulated handheld and orbits 0.03 to 0.2 %.
GOOD_FOCAL_SIGMA = 0.003
# Of the width. Corridor 0.45 %, simulated corridors 0.3 to 0.5 %, panoramas 0.5 %, 12 frames 0.33;
# street 0.1 %, fountain 0.07 %, handheld 0.1 %.
GOOD_CENTRE_SIGMA = 0.0025
GOOD_MOUNT_SIGMA_DEG = 0.1  # of a camera's direction. Corridor 0.09 (0.14 off), street 0.02

LISTED = 5


class Finding(Record):
    """One thing that is wrong or missing, and what to do."""

    camera: str | None  # None: the whole scan
    severity: Severity
    topic: str  # for programs: roll, corners, blur, ...
    what: str  # in words, with the number
    value: float | None = None  # the number alone
    remedy: str = ""


def finding(
    camera: str | None, severity: Severity, topic: str, what: str, value: float, remedy: str
) -> Finding:
    """A Finding, in the order in which one tells it."""
    return Finding(
        camera=camera, severity=severity, topic=topic, what=what, value=float(value), remedy=remedy
    )


def listed(names: Sequence[str]) -> str:
    """The first few names."""
    more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
    return ", ".join(names[:LISTED]) + more


def image_findings(scan: Scan, quality: Sequence[ImageQuality]) -> list[Finding]:
    """What the pixels alone say: blur and exposure, camera by camera."""
    found: list[Finding] = []
    for index, name in enumerate(scan.cameras):
        own = [each for each in quality if each.image.camera == index]
        for images, topic, word, remedy in (
            (
                blurred_images(own), "blur", "blurred",
                "move more slowly, give more light or a shorter exposure, check the focus; leave "
                "out what stays blurred",
            ),
            (
                [each for each in own if each.white > MOST_WHITE], "exposure", "largely white",
                "expose shorter, or keep sun and lamps out of view",
            ),
            (
                [each for each in own if dark_share(each, own) > MOST_BLACK], "exposure",
                "largely black", "expose longer, or give more light",
            ),
        ):  # fmt: skip
            if images:
                share = len(images) / len(own)
                which = listed([scan.frames[each.image.frame] for each in images])
                found.append(
                    finding(
                        name,
                        "doubtful" if share > MOST_BLURRED else "note",
                        topic,
                        f"{word}: {len(images)} of {len(own)} images ({which})",
                        share,
                        remedy,
                    )
                )
    return found


def blurred_images(own: Sequence[ImageQuality]) -> list[ImageQuality]:
    """The images of one camera that are too blurred, of themselves or beside its others."""
    widths = [each.edge_px for each in own if np.isfinite(each.edge_px)]
    usual = float(np.median(widths)) if widths else 0.0
    most = min(BLURRED_PX, max(BLURRED_BESIDE_PX, usual + WIDER_THAN_OTHERS_PX))
    return [each for each in own if each.edge_px > most]


def solve_findings(calibration: Calibration) -> list[Finding]:
    """What a quick solve states of lenses and rig: sigmas too wide, and what belief decides."""
    found: list[Finding] = []
    if calibration.solve and not calibration.solve.converged:
        what = f"a quick solve did not converge: {calibration.solve.reason}"
        remedy = "mend what else is found; give a nominal focal length in rig.yaml"
        found.append(
            Finding(camera=None, severity="cannot", topic="solve", what=what, remedy=remedy)
        )
    chosen = calibration.solve.selection if calibration.solve else None
    for name, camera in calibration.cameras.items():
        found += _focal_length(name, camera, chosen.sigma_factor if chosen else 1.0)
        found += _principal_point(name, camera)
        found += _direction(calibration, name)
    verdict = calibration.verdict
    for message in verdict.messages if verdict else ():
        if message.startswith("not usable: rays"):
            found.append(
                Finding(
                    camera=None, severity="cannot", topic="rays",
                    what=message.removeprefix("not usable: "),
                    remedy="let the camera move, turn and see things near and far",
                )
            )  # fmt: skip
    for weak in verdict.weak if verdict else ():
        found.append(
            Finding(
                camera=None,
                severity="doubtful",
                topic="weak",
                what=f"{weak.what}: {weak.sizes}",
                value=weak.slide_px,
                remedy=weak.remedy,
            )
        )
    return found


def _focal_length(name: str, camera: CameraResult, factor: float) -> Iterator[Finding]:
    """`factor`: sigmas of the quick solve over those of all observations."""
    worst = max(camera.sigma[p] / camera.params[p] for p in ("fx", "fy"))
    if worst > GOOD_FOCAL_SIGMA:
        usable = worst / factor <= USABLE_FOCAL_SIGMA
        limit = f"good: {GOOD_FOCAL_SIGMA:.1%}" if usable else f"usable: {USABLE_FOCAL_SIGMA:.0%}"
        yield finding(
            name,
            "doubtful" if usable else "cannot",
            "focal length",
            f"a quick solve knows the focal length to {worst:.2%} only ({limit})",
            worst,
            "bring near and far things into view, move sideways, turn the camera",
        )


def _principal_point(name: str, camera: CameraResult) -> Iterator[Finding]:
    worst, good = max(camera.sigma["cx"], camera.sigma["cy"]), GOOD_CENTRE_SIGMA * camera.size[0]
    if worst > good:
        yield finding(
            name,
            "doubtful",
            "principal point",
            f"a quick solve knows the principal point to {worst:.1f} px only (good: {good:.1f})",
            worst,
            "roll the camera about its line of sight between views, and tilt it",
        )


def _direction(calibration: Calibration, name: str) -> Iterator[Finding]:
    worst = max(calibration.rig.cam_from_rig[name].sigma_rotation_deg)
    if worst > GOOD_MOUNT_SIGMA_DEG:
        yield finding(
            name,
            "doubtful",
            "mount",
            f"a quick solve knows the camera's direction on the rig to {worst:.2f} deg only "
            f"(good: {GOOD_MOUNT_SIGMA_DEG:g})",
            worst,
            "let it see what other cameras see; roll and turn the rig",
        )
