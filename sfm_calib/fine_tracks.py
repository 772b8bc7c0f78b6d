"""A problem of all features out of a solved one of few: matched along lines, joined, completed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from graphs.frames import FloatArray, Transform
from graphs.problem import Estimate, IntArray, Observations, Problem
from graphs.track_building import consistent_tracks, join_matches
from sfm_calib.features import Features
from sfm_calib.images import Progress, Scan
from sfm_calib.line_matching import Sight, match_pairs, sight_of
from sfm_calib.overlap import pairs_that_share
from sfm_calib.track_completion import links_to_points

PAIRS_A_STEP = 20  # of progress
Links = tuple[IntArray, FloatArray]  # matches (n, 2) between features, and their likeness (n,)


@dataclass(frozen=True)
class _Placed:
    """The features of the images that have a place, those of all images in one row."""

    number: IntArray  # (n_cameras, n_frames) of each image in the scan; -1: no place
    found: Sequence[Features]
    owner: IntArray  # (n_features,) their image
    begins: IntArray  # (n_images + 1,) where each image's features begin
    spot: IntArray  # (n_features,) the first feature at the same pixel

    @property
    def images(self) -> list[tuple[int, int, int]]:
        """Camera, frame and number of each image with a place."""
        return [(c, f, int(self.number[c, f])) for c, f in np.argwhere(self.number >= 0).tolist()]

    def observations(self, track: IntArray) -> tuple[Observations, IntArray]:
        """Every feature of a track, and which it is (n_obs,)."""
        camera_of, frame_of = (np.full(len(self.found), -1) for _ in range(2))
        for camera, frame, number in self.images:
            camera_of[number], frame_of[number] = camera, frame
        rows = np.flatnonzero(track >= 0)
        pixels = np.concatenate([one.pixels for one in self.found])[rows]
        scales = np.concatenate([one.scales for one in self.found])[rows]
        image = self.owner[rows]
        seen = Observations(
            pixels, frame_of[image], camera_of[image], track[rows], feature_scale=scales
        )
        return seen, rows


def fine_problem(
    scan: Scan, coarse: Problem, found: Sequence[Features], progress: Progress
) -> Problem:
    """A problem of all features `found`, its lenses, rig and places those of a solved one."""
    start, placed = coarse.initial, _placed(scan, coarse, found)
    links = _links_along_lines(start, placed, pairs_that_share(coarse, placed.number), progress)
    points, seen, rows = _tracks(start, placed, links)
    order = np.argsort(seen.point, kind="stable")
    found_links = links_to_points(
        replace(start, points=points), placed.images, found, placed.begins,
        rows[order], seen.point[order],
    )  # fmt: skip
    total = len(placed.images)
    for done, (link, likeness) in enumerate(found_links, 1):
        links.append((placed.spot[link], likeness))
        progress("completing tracks", done, total)
    points, seen, _ = _tracks(start, placed, links)
    return replace(coarse, initial=replace(start, points=points), observations=seen)


def _placed(scan: Scan, coarse: Problem, found: Sequence[Features]) -> _Placed:
    frame_of = {name: number for number, name in enumerate(coarse.frame_names)}
    shown = np.zeros((len(scan.cameras), len(coarse.frame_names)), dtype=bool)
    shown[coarse.observations.camera, coarse.observations.frame] = True
    number = np.full(shown.shape, -1)
    for i, image in enumerate(scan.images):
        frame = frame_of.get(scan.frames[image.frame])
        if frame is not None and shown[image.camera, frame]:
            number[image.camera, frame] = i
    begins = np.concatenate([[0], np.cumsum([len(one) for one in found])])
    spots = [one.spots() + begin for one, begin in zip(found, begins[:-1], strict=True)]
    owner = np.repeat(np.arange(len(found)), np.diff(begins))
    return _Placed(number, found, owner, begins, np.concatenate(spots))


def _links_along_lines(
    start: Estimate, placed: _Placed, pairs: Sequence[tuple[int, int]], progress: Progress
) -> list[Links]:
    sights: list[Sight | None] = [None] * len(placed.found)
    places: list[Transform | None] = [None] * len(placed.found)
    for camera, frame, i in placed.images:
        sights[i] = sight_of(start.cameras[camera], placed.found[i])
        places[i] = start.cam_from_rig[camera] @ start.rig_from_world[frame]
    links = []
    for pair, (matches, likeness) in zip(pairs, match_pairs(sights, places, pairs), strict=True):
        links.append((placed.spot[matches + placed.begins[list(pair)]], likeness))
        if len(links) % PAIRS_A_STEP == 0 or len(links) == len(pairs):
            progress("matching along lines", len(links), len(pairs))
    return links


def _tracks(
    start: Estimate, placed: _Placed, links: Sequence[Links]
) -> tuple[np.ndarray, Observations, IntArray]:
    """Points, their observations, and the feature (n_obs,) of each observation."""
    matches = np.concatenate([pairs for pairs, _ in links])
    likeness = np.concatenate([likeness for _, likeness in links])
    seen, rows = placed.observations(join_matches(placed.owner, matches, likeness))
    points, kept, which = consistent_tracks(start, seen)
    return points, kept, rows[which]
