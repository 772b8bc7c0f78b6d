"""Whether an old calibration still holds, judged by a new one and both covariances.

Parameters trade with each other, so what is judged are changes in the picture, in px: of each
camera's lens, the turn taken out that undoes most of it; of where it points, that turn included;
of where it is. Places are free of the rig's frame, and of its size where the scan does not know it.
A test for each group of each camera, corrected for their number, says whether there is drift; what
each test could have found, whether its silence means anything. Two good calibrations of a rig
that nobody touched differ by more than their sigmas say, by what lens models and shutters leave:
so much is allowed beside them (`Criteria.systematic_px`).

Units, held parameters and the indices of cameras are as in `graphs.propagation`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from graphs.compare import Stated
from graphs.compare_rig import DepthError, PairPlace, depth_errors, pair_place
from graphs.covariance import Covariance
from graphs.drift_picture import GROUPS, LENS_GROUPS, Group
from graphs.drift_places import which_moved
from graphs.drift_tests import (
    Criteria,
    GroupDrift,
    PlaceTests,
    Tested,
    changes,
    judged,
    of_lenses,
    of_places,
)
from graphs.pose_covariance import rereferenced
from graphs.uncertainty import pairs

Verdict = Literal["keep", "replace", "inconclusive"]
OF_LENS: tuple[Tested, ...] = (*LENS_GROUPS, "lens")
# What has to be known for `keep`. Groups of a lens may be lost in each other with nothing in the
# picture lost; all of the lens is not, where a lens has more than one of them.
DECISIVE: tuple[Tested, ...] = ("lens", "rotation", "translation")


LEAST_SHOWN = 1e-3  # of a drift: less is none


@dataclass(frozen=True)
class PairDrift:
    """How two cameras sit to each other, and what the old calibration costs in depth."""

    cameras: tuple[int, int]
    place: PairPlace  # A: old, B: new
    depth: tuple[DepthError, ...]  # by the old calibration, where the new one is true


@dataclass(frozen=True)
class Drift:
    """What changed, what could have been seen, and what follows."""

    old: Stated  # both in the frame of the first camera, and in the old one's unit
    new: Stated
    criteria: Criteria
    tests: tuple[GroupDrift, ...]
    moved: tuple[tuple[int, ...], ...]  # sets of cameras whose moving explains it: one, or another
    by_lens: bool  # which of them moved is told by the lenses: a changed one has been touched
    scale_free: bool  # the size of the rig is not judged
    pairs: tuple[PairDrift, ...]
    verdict: Verdict

    @property
    def found(self) -> tuple[GroupDrift, ...]:
        """The tests that found drift, the surest first."""
        some = (test for test in self.tests if test.p_corrected < self.criteria.alpha)
        return tuple(sorted(some, key=lambda test: test.p_value))

    @property
    def drifted(self) -> tuple[int, ...]:
        """Cameras that changed: that moved, where it can be told, or have another lens."""
        lenses = {test.cameras[0] for test in self.found if test.group in OF_LENS}
        return tuple(sorted(lenses.union(*self.moved if len(self.moved) == 1 else ())))

    @property
    def decisive(self) -> tuple[GroupDrift, ...]:
        """The tests that have to be able to find what matters, for the old one to be kept."""
        whole = {test.cameras for test in self.tests if test.group == "lens"}
        return tuple(
            test
            for test in self.tests
            if test.group in DECISIVE or (test.group in LENS_GROUPS and test.cameras not in whole)
        )

    @property
    def unresolved(self) -> tuple[GroupDrift, ...]:
        """Those that are not, the worst first."""
        lost = (t for t in self.decisive if t.detectable_px > self.criteria.matters_px)
        return tuple(sorted(lost, key=lambda test: -test.detectable_px))

    @property
    def detectable_px(self) -> float:
        """The smallest drift in px that is found wherever it is."""
        return max((test.detectable_px for test in self.decisive), default=0.0)


def drift(
    old: Stated,
    new: Stated,
    criteria: Criteria | None = None,
    *,
    scale_free: bool = False,
    tested: Collection[tuple[str, Group]] | None = None,
    cov_difference: Covariance | None = None,
    n_frames: int | None = None,
    n_frames_old: int | None = None,
    leaning: Mapping[tuple[str, Group], float] | None = None,
) -> Drift:
    """Hold a new calibration against an old one of the same cameras, in the same lenses.

    Lengths in one unit; scale_free: those of the new one in any. tested: (camera, group) that the
    new solve freed; all, where it is not given. Lens groups that are not among them count as
    unchanged. cov_difference: of new less old where these are not independent, labelled and in the
    frame as they are; the sum of theirs, where it is not given. n_frames, n_frames_old: on
    which the new and the old covariance rest, which few of them leave in doubt; None: it is known.
    leaning: of lens groups, the share of what the new solve knows that is a belief centred on the
    old calibration: of a drift, so much does not show. Raises ValueError where cameras are not the
    same, in the same order and lenses.
    """
    criteria = criteria or Criteria()
    _check_alike(old, new)
    if cov_difference is not None:
        cov_difference = _of_first(Stated(new.estimate, cov_difference)).covariance
    old, new = _of_first(old), _of_first(new)
    if scale_free:
        new = new.scaled(_size(old) / _size(new))
    freed = tuple(
        frozenset(g for g in GROUPS if tested is None or (camera.name, g) in tested)
        for camera in old.estimate.cameras
    )
    apart = changes(old, new, criteria.range, freed, cov_difference, (n_frames_old, n_frames))
    lenses = tuple(of_lenses(apart, criteria.systematic_px))
    places = of_places(apart, criteria.systematic_px, scale_free)
    hidden = leaning or {}
    first = _shown(judged([*lenses, *places.rows()], criteria), old, hidden)
    moved, by_lens = _moved(places, first, criteria.alpha)
    # Once it is known which moved, the frame is that of the others: they stay.
    final = first
    if len(moved) == 1:
        final = _shown(judged([*lenses, *places.rows(moved[0])], criteria), old, hidden)
    of_pairs = tuple(_pair(old, new, pair, criteria) for pair in pairs(old.estimate))
    result = Drift(old, new, criteria, final, moved, by_lens, scale_free, of_pairs, "replace")
    if any(test.p_corrected < criteria.alpha for test in first):
        return result
    return replace(result, verdict="inconclusive" if result.unresolved else "keep")


def _shown(
    tests: Sequence[GroupDrift], old: Stated, leaning: Mapping[tuple[str, Group], float]
) -> tuple[GroupDrift, ...]:
    """With what can be found of what shows: a belief in the old lens pulls the new one to it."""

    def share(test: GroupDrift) -> float:
        if test.group not in OF_LENS:
            return 0.0
        name = old.estimate.cameras[test.cameras[0]].name
        of = LENS_GROUPS if test.group == "lens" else (test.group,)
        return max(leaning.get((name, group), 0.0) for group in LENS_GROUPS if group in of)

    return tuple(
        replace(test, detectable_px=test.detectable_px / max(1 - share(test), LEAST_SHOWN))
        for test in tests
    )


def _check_alike(old: Stated, new: Stated) -> None:
    for a, b in zip(old.estimate.cameras, new.estimate.cameras, strict=True):
        if (a.name, a.lens, a.size) != (b.name, b.lens, b.size):
            raise ValueError(
                f"{a.name} ({a.lens}, {a.size[0]} x {a.size[1]}) is no {b.name} ({b.lens}, "
                f"{b.size[0]} x {b.size[1]}): drift is of one camera in one lens"
            )


def _of_first(side: Stated) -> Stated:
    return Stated(*rereferenced(side.estimate, side.covariance, 0))


def _size(side: Stated) -> float:
    return float(np.linalg.norm([t.translation for t in side.estimate.cam_from_rig])) or 1.0


def _pair(old: Stated, new: Stated, pair: tuple[int, int], criteria: Criteria) -> PairDrift:
    depth = depth_errors(old, new, pair, criteria.depth_ranges)
    return PairDrift(pair, pair_place(old, new, pair), depth)


def _moved(
    places: PlaceTests, tests: Sequence[GroupDrift], alpha: float
) -> tuple[tuple[tuple[int, ...], ...], bool]:
    """Sets of cameras whose moving explains what was found, and whether lenses chose among them."""
    found = [test for test in tests if test.p_corrected < alpha]
    if all(test.group in OF_LENS for test in found):
        return (), False
    sets = which_moved(places.places, places.suspects)
    touched = {test.cameras[0] for test in found if test.group in OF_LENS}
    of_touched = tuple(one for one in sets if touched.issuperset(one))
    return (of_touched, True) if len(sets) > 1 and len(of_touched) == 1 else (sets, False)
