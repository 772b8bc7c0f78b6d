"""Matches in COLMAP's database: made by it or brought to it, and verified by it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pycolmap

from graphs.problem import IntArray
from sfm_calib.colmap import colmap_errors
from sfm_calib.images import Progress, Scan
from sfm_calib.pairs import Pair

PAIRS_A_BATCH = 200  # progress and Ctrl-C between batches


def match_features(
    scan: Scan, pairs: Sequence[Pair], database: Path, seed: int, progress: Progress
) -> None:
    """Match the given pairs by SIFT and keep what one epipolar geometry explains."""
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    pairing = pycolmap.ImportedPairingOptions()
    for done, pairing.match_list_path in _listed(scan, pairs, database):
        with colmap_errors():
            pycolmap.match_image_pairs(
                database, options, pairing, _verification(seed), pycolmap.Device.cpu
            )
        progress("matching", done, len(pairs))


@contextmanager
def match_writer(database: Path) -> Iterator[Callable[[str, str, IntArray], None]]:
    """For matches made elsewhere: tells a database the features (n, 2) of two images that match."""
    with pycolmap.Database.open(database) as db:
        numbers = {image.name: image.image_id for image in db.read_all_images()}
        yield lambda a, b, matches: db.write_matches(
            numbers[a], numbers[b], matches.astype(np.uint32)
        )


def verify_matches(
    scan: Scan, pairs: Sequence[Pair], database: Path, seed: int, progress: Progress
) -> None:
    """Keep what one epipolar geometry explains of the matches that the database has of pairs."""
    for done, listing in _listed(scan, pairs, database):
        with colmap_errors():
            pycolmap.verify_matches(database, listing, _verification(seed))
        progress("verifying matches", done, len(pairs))


def _verification(seed: int) -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed  # else threads share one stream of random numbers
    return options


def _listed(scan: Scan, pairs: Sequence[Pair], database: Path) -> Iterator[tuple[int, Path]]:
    """A file that names the pairs of one batch, and how many of all are then done.

    COLMAP cuts the lines of its list at blanks, which paths may hold and numbers do not: while
    this goes on images are called by their numbers.
    """
    listing = database.with_name("pairs.txt")
    numbers = {image.path: str(index) for index, image in enumerate(scan.images)}
    _rename_images(database, numbers)
    for begin in range(0, len(pairs), PAIRS_A_BATCH):
        batch = pairs[begin : begin + PAIRS_A_BATCH]
        listing.write_text("".join(f"{a} {b}\n" for a, b in batch))
        yield begin + len(batch), listing
    _rename_images(database, {number: path for path, number in numbers.items()})


def _rename_images(database: Path, names: dict[str, str]) -> None:
    with pycolmap.Database.open(database) as db:
        for image in db.read_all_images():
            image.name = names[image.name]
            db.update_image(image)


def match_counts(scan: Scan, database: Path) -> dict[Pair, int]:
    """Verified matches of each pair of images."""
    number = {image.path: index for index, image in enumerate(scan.images)}
    with pycolmap.Database.open(database) as db:
        names = {image.image_id: image.name for image in db.read_all_images()}
        pair_ids, counts = db.read_two_view_geometry_num_inliers()
    counted: dict[Pair, int] = {}
    for pair_id, count in zip(pair_ids, counts, strict=True):
        ids = pair_id if isinstance(pair_id, tuple) else pycolmap.pair_id_to_image_pair(pair_id)
        a, b = sorted(number[names[image_id]] for image_id in ids)
        counted[a, b] = int(count)
    return counted
