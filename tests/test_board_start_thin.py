"""Frames that tell nothing new, and a diverse choice of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from test_board_start import BOARD, PINHOLE, View, mono_views, seen
from test_board_start_rig import PLAIN, SIZE, STEREO, rig_views, waved

from graphs.board_thin import layouts, redundant, thin
from graphs.planar import Transforms, gather, turned_over

SIZES = [PINHOLE.size]


def again(view: View, frame: int, shift_px: float, rng: np.random.Generator) -> View:
    noise = 0.2 * rng.standard_normal(view.pixels.shape)
    return replace(view, frame=frame, pixels=view.pixels + shift_px + noise)


def test_a_board_held_still_is_one_group() -> None:
    rng = np.random.default_rng(0)
    views, _ = mono_views(PINHOLE, 5, rng)
    views += [again(views[2], frame, 0.0, rng) for frame in (5, 6)]
    views += [again(views[4], 7, 20.0, rng)]
    assert redundant(views, len(BOARD), SIZES) == ((2, 5, 6),)
    assert redundant(views[:5], len(BOARD), SIZES) == ()


def test_a_board_that_drifts_slowly_is_not_one_group() -> None:
    """1 % of the width is 6.4 px; each frame is 3 px further."""
    rng = np.random.default_rng(1)
    (first,), _ = mono_views(PINHOLE, 1, rng, share=0.1)
    views = [again(first, frame, 3.0 * frame / np.sqrt(2), rng) for frame in range(9)]
    assert redundant(views, len(BOARD), SIZES) == ((0, 1, 2), (3, 4, 5), (6, 7, 8))


def test_only_common_corners_are_compared() -> None:
    rng = np.random.default_rng(2)
    (first,), _ = mono_views(PINHOLE, 1, rng, share=0.1)
    parts = [first.corner < 30, first.corner >= 20, first.corner >= 40]
    views = [
        replace(again(first, frame, 0.0, rng), corner=first.corner[part])
        for frame, part in enumerate(parts)
    ]
    views = [replace(v, pixels=v.pixels[part]) for v, part in zip(views, parts, strict=True)]
    assert redundant(views, len(BOARD), SIZES) == ((0, 1),)


def test_in_a_rig_all_cameras_must_see_the_board_still() -> None:
    rng = np.random.default_rng(3)
    views = rig_views([PLAIN] * 2, STEREO, [waved(rng, 0) for _ in range(3)], rng)
    left, right = (next(v for v in views if (v.camera, v.frame) == (c, 1)) for c in (0, 1))
    both_still = [*views, again(left, 3, 0.0, rng), again(right, 3, 0.0, rng)]
    assert redundant(both_still, len(BOARD), [SIZE] * 2) == ((1, 3),)
    one_moved = [*views, again(left, 3, 0.0, rng), again(right, 3, 30.0, rng)]
    assert redundant(one_moved, len(BOARD), [SIZE] * 2) == ()
    one_alone = [*views, again(left, 3, 0.0, rng)]
    assert redundant(one_alone, len(BOARD), [SIZE] * 2) == ()


def test_thinning_takes_the_few_that_differ() -> None:
    """200 frames of one place and 10 of others: the others are taken."""
    rng = np.random.default_rng(4)
    other, _ = mono_views(PINHOLE, 11, rng)
    still = [again(other[0], 0, 2 * rng.standard_normal(), rng) for _ in range(200)]
    views = [replace(v, frame=i) for i, v in enumerate([*still[:100], *other[1:], *still[100:]])]
    kept = thin(views, 11, BOARD, SIZES)
    assert set(range(100, 110)) <= set(kept) and len(kept) == 11
    assert kept == tuple(sorted(kept)) == thin(views, 11, BOARD, SIZES)


def test_thinning_spreads_better_than_every_nth() -> None:
    rng = np.random.default_rng(5)
    views, _ = mono_views(PINHOLE, 120, rng)
    layout = layouts(gather(views, BOARD), BOARD, SIZES)

    def least_apart(kept: list[int]) -> float:
        apart = np.linalg.norm(layout[kept][:, None] - layout[kept][None], axis=2)
        return float((apart + 10 * np.eye(len(kept))).min())

    kept = list(thin(views, 12, BOARD, SIZES))
    assert least_apart(kept) > 2 * least_apart(list(range(0, 120, 10)))


def test_a_tilt_and_its_opposite_lie_differently() -> None:
    """Their outlines are alike: only the perspective tells them apart."""
    rng = np.random.default_rng(6)
    views, placed = mono_views(PINHOLE, 10, rng, (0.9, 1.0), (30, 35), 0.3)
    over = turned_over(gather(views, BOARD), Transforms.of(placed))
    opposite = []
    for index, view in enumerate(views):
        corner, pixels = seen(PINHOLE, over.one(index), rng)
        opposite.append(replace(view, corner=corner, pixels=pixels))
    ours, theirs = (layouts(gather(v, BOARD), BOARD, SIZES) for v in (views, opposite))
    assert np.linalg.norm((ours - theirs)[:, :6], axis=1).max() < 0.02
    assert np.linalg.norm((ours - theirs)[:, 6:], axis=1).min() > 0.05


def test_frames_that_link_cameras_are_preferred() -> None:
    """30 frames of the left camera alone, 4 that both see: those come in."""
    rng = np.random.default_rng(7)
    views = rig_views([PLAIN] * 2, STEREO, [waved(rng, 0) for _ in range(34)], rng)
    views = [v for v in views if v.camera == 0 or v.frame % 9 == 0]
    kept = thin(views, 8, BOARD, [SIZE] * 2)
    frames = {views[i].frame for i in kept}
    assert len(frames) == 8 and {0, 9, 18, 27} <= frames
    assert {i for i, v in enumerate(views) if v.frame in frames} == set(kept)


def test_nothing_is_thinned_where_there_is_little() -> None:
    views, _ = mono_views(PINHOLE, 5, np.random.default_rng(8))
    assert thin(views, 5, BOARD, SIZES) == (0, 1, 2, 3, 4)
