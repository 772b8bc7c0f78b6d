"""Links between a rig's cameras: votes of frames, and the images where votes leave a doubt."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from graphs.board_frames import RigFrames, SeenFrames, resolve_frames
from graphs.board_rig import Link, proposed_links
from graphs.frames import Transform
from graphs.lenses import IntArray

# How much more of a view's squared error, in logarithms a corner, makes one place the better one.
CLEARLY_BETTER = 0.1
SMALLEST_RMS_PX = 0.05


def links_between(seen: SeenFrames) -> list[Link]:
    """The link of each pair of cameras that share frames."""
    links = []
    for a, b in combinations(range(len(seen.cameras)), 2):
        own_a, own_b = (np.flatnonzero(seen.corners.camera == camera) for camera in (a, b))
        _, first, second = np.intersect1d(seen.frame[own_a], seen.frame[own_b], return_indices=True)
        if first.size:
            links.append(_link(seen, (a, b), own_a[first], own_b[second]))
    return links


def _link(seen: SeenFrames, cameras: tuple[int, int], a: IntArray, b: IntArray) -> Link:
    """What the frames vote for; between two places with nearly as many votes the images decide."""
    best, rival = proposed_links(cameras, seen.candidates[a], seen.candidates[b])
    if rival is None or best.refused:
        return best
    pair, choices = seen.of_pair(a, b), (best, rival)
    tried = [resolve_frames(pair, [Transform.identity(), each.b_from_a], 0) for each in choices]
    typical = max(min(float(np.median(each.rms_px)) for each in tried), SMALLEST_RMS_PX)
    counts = pair.corners.counts
    scores = [float(np.log1p((each.rms_px / typical) ** 2) @ counts) for each in tried]
    ambiguous = abs(scores[0] - scores[1]) < CLEARLY_BETTER * counts.sum()
    # Where the images hardly tell, boards are rather numbered alike; then the little they tell
    # decides. A small board always held in one place votes for the rig's mirror image as well, and
    # that is taken for the rig half of the time without it.
    apart = [_numbered_apart(each, len(a)) if ambiguous else 0 for each in tried]
    taken = int((apart[1], scores[1]) < (apart[0], scores[0]))
    placed = tried[taken].cam_from_rig.one(1)
    return replace(choices[taken], b_from_a=placed, ambiguous=bool(ambiguous))


def _numbered_apart(resolved: RigFrames, n_frames: int) -> int:
    """Frames whose two views are numbered from different ends."""
    renumbering = resolved.renumbering
    return int((renumbering[:n_frames] != renumbering[n_frames:]).sum())


def check_linked(
    camera_names: Sequence[str],
    found: Mapping[int, Transform],
    links: Sequence[Link],
    seen: SeenFrames,
) -> None:
    """Raises ValueError naming the cameras that no link places (all but `found`), with counts."""
    lost = [camera for camera in range(len(camera_names)) if camera not in found]
    if not lost:
        return
    names = ", ".join(camera_names[camera] for camera in lost)
    linked = ", ".join(camera_names[camera] for camera in sorted(found))
    ours = np.unique(seen.frame[np.isin(seen.corners.camera, list(found))])
    theirs = np.unique(seen.frame[np.isin(seen.corners.camera, lost)])
    verb = "never sees" if len(lost) == 1 else "never see"
    refused = [each for each in links if (each.cameras[0] in found) != (each.cameras[1] in found)]
    if refused:
        most = max(refused, key=lambda each: each.agreeing)
        a, b = (camera_names[camera] for camera in most.cameras)
        raise ValueError(
            f"{names} cannot be placed beside {linked}: at best {most.agreeing} of {most.frames} "
            f"frames that {a} and {b} share agree on where they stand; check that frames of one "
            "name are of one moment"
        )
    raise ValueError(
        f"{names} {verb} the board together with {linked}: {len(theirs)} frames against "
        f"{len(ours)}, none of them shared; show the board to both at once"
    )
