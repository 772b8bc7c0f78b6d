"""What the geometry of a scan lacks: rules with their thresholds, each with a remedy.

The thresholds rest on the real scans (corridor, street, fountain: all usable, each weak in its own
way) and on simulated ones: 40 frames of one or two cameras, 640 px wide, 0.5 px noise, a handheld
walk changed in one respect at a time. "In the image" is the largest error of a projection.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from graphs.coverage import CameraCoverage, Coverage
from sfm_calib.findings import Finding, finding, listed
from sfm_calib.images import Scan
from sfm_calib.mapping import ENOUGH_REGISTERED
from sfm_calib.verdict import FEW_FRAMES

GOOD_FRAMES = 20  # 8 frames: cy 4.6 px off, 12: cx 2.9; 20: 0.6, 40: 0.5
POOR_IMAGE = 30  # points: an image's place takes six numbers. Corridor 123 at least

# ---- what is seen ---------------------------------------------------------------------------

# Points within the middle 80 % of width and height only (64 % of the cells, no corner): 1.3 px in
# the image, 70 %: 4 px, 60 %: 15 px; everywhere: 0.3 px. One side empty, 80 % covered: 0.7 px.
LEAST_COVERED = 0.8
MOST_EMPTY_CORNERS = 1  # one may show sky throughout
# Median. One handheld camera that moves a tenth as far (1.4 deg): f 2 px off, 3 px in the image; a
# fifth (2.8 deg): 0.3 px. Corridor and street 4, fountain 42 deg.
LEAST_PARALLAX_DEG = 2.0
# A wall with things on it, views turned by 6 deg: sigma of f 2.1 px (thickness 0.09, depths 1 to
# 1.4), 1.2 px (0.22, 1 to 1.6), 0.9 px (0.42, 1 to 2), of a bare wall 20 px; a bare wall with views
# turned by 19 deg: 2.4 px, by 39 deg: 0.8 px. Street 0.22, fountain 0.36, corridor 0.43.
LEAST_THICKNESS = 0.1
LEAST_DEPTH_RATIO = 1.5
ENOUGH_TURN_DEG = 30.0
# Points seen by two cameras in one frame. Simulated neighbours share 467 to 1807, corridor 1909;
# 26 will do for two cameras that a third one joins.
FEW_SHARED = 100

# ---- how the camera moved -------------------------------------------------------------------

# About the line of sight. Corridor 1 and 3, street 4, fountain 5 deg: principal points 3 to 14 px
# off. Simulated with turns to the sides alone: sigma of cx, cy 1.1, 1.2 px with 4 deg of roll, 0.9,
# 1.0 px with 8; 0.3, 0.7 px with 18 deg.
LEAST_ROLL_DEG = 10.0
LEAST_TURN_DEG = 10.0  # up and down: sigma of cy 1.2 px with 3 deg, 0.7 with 27
MOST_FORWARD = 0.9  # of its way. Corridor 0.99, street 1.00 (weak); handheld 0.44, fountain 0.21


def coverage_findings(scan: Scan, frame_names: Sequence[str], covered: Coverage) -> list[Finding]:
    """What the geometry says, camera by camera. `frame_names`: those of the covered problem."""
    found: list[Finding] = []
    for index, camera in enumerate(covered.cameras):
        taken = sum(image.camera == index for image in scan.images)
        found += _images(camera, taken, frame_names)
        found += _image_plane(camera)
        found += _parallax(camera)
        found += _depths(camera)
        found += _turns(camera)
        found += _way(camera)
        if len(covered.cameras) > 1:
            found += _overlap(covered, index)
    return found


def _images(camera: CameraCoverage, taken: int, frame_names: Sequence[str]) -> Iterator[Finding]:
    placed = camera.n_images
    if placed < ENOUGH_REGISTERED * taken:
        yield finding(
            camera.name,
            "doubtful",
            "placed",
            f"only {placed} of its {taken} images could be placed",
            placed / taken,
            "let neighbouring views overlap more, and show textured things",
        )
    if placed < GOOD_FRAMES:
        yield finding(
            camera.name,
            "doubtful" if placed < FEW_FRAMES else "note",
            "images",
            f"{placed} images are few (good: {GOOD_FRAMES})",
            placed,
            "take more views, from other places and turned otherwise",
        )
    poor = [frame_names[frame] for frame in camera.frames[camera.per_image < POOR_IMAGE]]
    if poor:
        yield finding(
            camera.name,
            "note",
            "texture",
            f"images with fewer than {POOR_IMAGE} usable points: {len(poor)} ({listed(poor)})",
            len(poor),
            "point the camera at textured things",
        )


def _image_plane(camera: CameraCoverage) -> Iterator[Finding]:
    share, corners = camera.plane.covered, camera.plane.corners
    if share < LEAST_COVERED:
        yield finding(
            camera.name,
            "doubtful",
            "coverage",
            f"usable points lie in {share:.0%} of its image only (good: {LEAST_COVERED:.0%}); the "
            "distortion of the rest is a guess",
            share,
            "let textured things pass through all of the image, its borders too",
        )
    places = ("top left", "top right", "bottom left", "bottom right")
    empty = [place for place, hit in zip(places, corners, strict=True) if hit is False]
    if empty:
        yield finding(
            camera.name,
            "doubtful" if len(empty) > MOST_EMPTY_CORNERS else "note",
            "corners",
            f"hardly a usable point in its image's corners {', '.join(empty)}, where distortion is "
            "largest",
            len(empty),
            "turn the camera so that textured things come into these corners",
        )


def _parallax(camera: CameraCoverage) -> Iterator[Finding]:
    median = float(np.nan_to_num(camera.scene.parallax_deg[1]))
    if median < LEAST_PARALLAX_DEG:
        yield finding(
            camera.name,
            "doubtful",
            "parallax",
            "it hardly moved beside the distance of what it saw: half of the points are seen from "
            f"directions less than {median:.1f} deg apart (good: {LEAST_PARALLAX_DEG:g})",
            median,
            "move farther sideways, or come closer to things; turning on the spot is not enough",
        )


def _depths(camera: CameraCoverage) -> Iterator[Finding]:
    scene = camera.scene
    flat = scene.thickness < LEAST_THICKNESS
    if not flat and not scene.depth_ratio < LEAST_DEPTH_RATIO:
        return
    if flat:
        what = f"what it saw is nearly a flat wall (thickness {scene.thickness:.0%} of its width)"
    else:
        what = f"all it saw is about equally far (distances 1 to {scene.depth_ratio:.1f})"
    turned = max(camera.motion.rotation_deg[:2])
    if turned < ENOUGH_TURN_DEG:
        what += f", and it was turned by {turned:.0f} deg only: focal length and distance get mixed"
    yield finding(
        camera.name,
        "doubtful" if turned < ENOUGH_TURN_DEG else "note",
        "depth",
        what,
        scene.thickness if flat else scene.depth_ratio,
        f"bring near and far things into view, or look at it from {ENOUGH_TURN_DEG:.0f} deg aside",
    )


def _turns(camera: CameraCoverage) -> Iterator[Finding]:
    up_down, aside, roll = camera.motion.rotation_deg
    rolled = roll >= LEAST_ROLL_DEG
    if not rolled:
        yield finding(
            camera.name,
            "doubtful",
            "roll",
            f"it is hardly rolled about its line of sight: {roll:.0f} deg (good: "
            f"{LEAST_ROLL_DEG:.0f}), so a wrong principal point (cx, cy) passes for a turn",
            roll,
            "take some views tipped to the left and to the right; where the rig cannot, state what "
            "you know of cx, cy in rig.yaml (params and sigma of the camera)",
        )
    for turn, topic, words, hurt in (
        (up_down, "tilt", "tilted up and down", "fy and cy"),
        (aside, "turn", "turned to the sides", "fx and cx"),
    ):
        if turn < LEAST_TURN_DEG:
            yield finding(
                camera.name,
                "note" if rolled else "doubtful",
                topic,
                f"it is hardly {words}: {turn:.0f} deg (good: {LEAST_TURN_DEG:.0f}), so {hurt} "
                "rest on little",
                turn,
                f"add views {words}, by {LEAST_TURN_DEG:.0f} deg or more",
            )


def _way(camera: CameraCoverage) -> Iterator[Finding]:
    forward = camera.motion.path_share[2]
    if forward > MOST_FORWARD:
        yield finding(
            camera.name,
            "doubtful",
            "forward",
            f"{forward:.0%} of its way runs along its line of sight (good: under "
            f"{MOST_FORWARD:.0%}): focal length, distortion and distance are hard to tell apart",
            forward,
            "add stretches on which it moves sideways, or up and down",
        )


def _overlap(covered: Coverage, index: int) -> Iterator[Finding]:
    others = [other for other in range(len(covered.cameras)) if other != index]
    best = max(others, key=lambda other: covered.shared_at_once[index, other])
    count = int(covered.shared_at_once[index, best])
    if count >= FEW_SHARED:
        return
    ever = max(int(covered.shared_ever[index, other]) for other in others)
    yield finding(
        covered.cameras[index].name,
        "doubtful" if ever < FEW_SHARED else "note",
        "overlap",
        f"it shares {count} points at one moment with the camera it overlaps most "
        f"({covered.cameras[best].name}; good: {FEW_SHARED}), {ever} at different moments: its "
        "place on the rig comes from how both move",
        count,
        "let cameras see the same things, at once or one after the other; turn the rig about two "
        "axes, and move it",
    )
