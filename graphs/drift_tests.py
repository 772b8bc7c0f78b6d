"""The tests of a drift: one for each group of each camera, and what each could have found."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy.linalg

from graphs.camera import Camera
from graphs.compare import Stated
from graphs.compare_chance import changed
from graphs.covariance import Covariance
from graphs.drift_picture import GROUPS, Group, Picture, lens_columns, picture, share
from graphs.drift_places import Places, frame_changes
from graphs.frames import FloatArray, exp_rotation, log_rotation
from graphs.pose_covariance import form_names, poses_as
from graphs.problem import Estimate
from graphs.propagation import cross_covariance, lens_names
from graphs.significance import Guess, degrees, detectable, holm, significance

Tested = Literal[Group, "lens", "places"]  # lens: all of it; places: of all cameras together
Freed = tuple[frozenset[Group], ...]  # of each camera, what the new solve freed
AXES = ("x", "y", "z")
DRAWS, SEED = 24, 0
# Of the allowance in px, what a camera's place gets: lens models and shutters bend directions, and
# none of the evidence is of lengths. With all of it, 15 of 39 simulated scans find that a baseline
# of 0.2 m grew by 0.5 %, and 2 of 24 of three cameras, which sigmas let all of them find; with 0.75
# of it 35 and 12, with half 39 and 22, with a quarter all 51 and 55 of 57.
OF_PLACE = 0.25
LEAST_BASELINE = 0.1  # of the other one: a baseline as short has no direction to keep


@dataclass(frozen=True)
class Criteria:
    """By what is judged."""

    # rms over an image, all groups together, allowed beside the sigmas. Boards and a scan of a
    # stereo rig that nobody touched differ by 0.06 to 0.07 deg of roll (0.28 to 0.39 px) with a
    # sigma of 0.0165 deg: p = 0.04 with 0.1 px, 0.08 with 0.15, 0.15 with 0.2.
    systematic_px: float = 0.2
    matters_px: float = 1.0  # a drift that must be found, for the old calibration to be kept
    alpha: float = 0.05  # chance of drift found in all tests together where there is none
    power: float = 0.95  # chance of finding what is called detectable
    range: float = 2.0  # of the points in which a change of place is judged, in the unit of length
    depth_ranges: tuple[float, ...] = (1.0, 2.0, 5.0, 10.0)


@dataclass(frozen=True)
class GroupDrift:
    """One test: how a group of parameters changed, new less old.

    rotation (rad, about the camera's axes): where the camera points, with the turn that the change
    of its lens amounts to. translation: of its centre, along its own axes,
    the length of the baseline to the first camera and its direction apart. Both in the frame of the
    other cameras. Of a pair: of the second, seen from the first.
    """

    cameras: tuple[int, ...]  # one; the pair, where it cannot be told which; or all
    group: Tested
    names: tuple[str, ...]
    change: FloatArray  # (k,)
    sigma: FloatArray  # (k,) by both covariances, nothing allowed beside them
    chi2: float
    dof: int
    nu: float  # degrees of freedom of its covariance; infinite: it is known
    p_value: float
    p_corrected: float  # Holm's, of all tests
    effect_px: float  # rms over the image; of translation at `Criteria.range`, and as 1 / range
    expected_px: float  # rms that chance lets expect, with what is allowed beside it
    detectable_px: float  # every change of this effect is found with `Criteria.power`


@dataclass(frozen=True)
class Row:
    """A test before it is made."""

    cameras: tuple[int, ...]
    group: Tested
    names: tuple[str, ...]
    change: FloatArray  # (k,)
    sigma: FloatArray  # (k,)
    change_px: FloatArray  # (m,) as long as the effect is large
    cov_px: FloatArray  # (m, m) with what is allowed
    nu: float  # its degrees of freedom


def judged(rows: Sequence[Row], criteria: Criteria) -> tuple[GroupDrift, ...]:
    """All tests together: each is corrected for the others."""
    results = [significance(row.change_px, row.cov_px, row.nu) for row in rows]
    corrected = holm([result.p_value for result in results])
    return tuple(
        GroupDrift(
            row.cameras, row.group, row.names, row.change, row.sigma,
            result.chi2, result.dof, row.nu, result.p_value, float(p),
            float(np.linalg.norm(row.change_px)),
            max(float(np.trace(row.cov_px)), 0.0) ** 0.5,
            detectable(row.cov_px, criteria.alpha / len(rows), criteria.power, row.nu),
        )
        for row, result, p in zip(rows, results, corrected, strict=True)
    )  # fmt: skip


# ---- changes -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Changes:
    """New less old, of every parameter: lenses, and places as left twists."""

    estimate: Estimate  # the old one
    pictures: tuple[Picture, ...]
    freed: Freed
    names: tuple[str, ...]
    change: FloatArray  # (n,)
    cov: FloatArray  # (n, n)
    guesses: tuple[Guess, ...]  # parts of cov that rest on how much frames differ

    def lens_of(self, camera: int) -> list[int]:
        """Columns of a camera's lens."""
        first = self.names.index(lens_names(self.estimate.cameras[camera])[0])
        return list(range(first, first + len(self.estimate.cameras[camera].names)))


def changes(
    old: Stated,
    new: Stated,
    distance: float,
    freed: Freed,
    cov_difference: Covariance | None,
    n_frames: tuple[int | None, int | None],
) -> Changes:
    """Of two calibrations in one frame and unit; lens groups that were not freed did not change.

    n_frames: that the covariance of the old one rests on, and of the new one; None: it is known.
    """
    names: list[str] = []
    held = []
    for index, camera in enumerate(old.estimate.cameras):
        names += [*lens_names(camera), *form_names(camera.name, "left_twist")]
        for group, columns in lens_columns(camera):
            if group not in freed[index]:
                held += [names.index(lens_names(camera)[column]) for column in columns]
    change = _apart(old.estimate, new.estimate)
    to_old = _carrying(old.estimate, new.estimate)
    between = new if cov_difference is None else Stated(new.estimate, cov_difference)
    parts = [to_old @ _as_twists(between, names) @ to_old.T + _curvature(between, old.estimate)]
    if cov_difference is None:
        parts.append(_as_twists(old, names) + _curvature(old, new.estimate))
    change[held] = 0.0
    for part in parts:
        part[held], part[:, held] = 0.0, 0.0
    pictures = tuple(
        picture(_between(a, b), distance)
        for a, b in zip(old.estimate.cameras, new.estimate.cameras, strict=True)
    )
    known = [count for count in n_frames if count is not None]
    # Of a difference that was given, both sides have a part, and the fewer frames count.
    counts = list(reversed(n_frames)) if cov_difference is None else [min(known, default=None)]
    guesses = tuple(
        Guess(part, max(count - 1.0, 1.0))
        for part, count in zip(parts, counts, strict=True)
        if count is not None
    )
    return Changes(old.estimate, pictures, freed, tuple(names), change, np.sum(parts, 0), guesses)


def _apart(old: Estimate, new: Estimate) -> FloatArray:
    """The change (n,) of all lenses and left twists."""
    apart = []
    for index, (one, other) in enumerate(zip(old.cameras, new.cameras, strict=True)):
        a, b = (side.cam_from_rig[index] for side in (old, new))
        turn = b.rotation @ a.rotation.T
        moved = _polar(a.translation, turn.T @ b.translation)[0]
        apart += [other.params - one.params, log_rotation(turn), moved]
    return np.concatenate(apart)


def _carrying(old: Estimate, new: Estimate) -> FloatArray:
    """What carries changes (n,) of the new one to the old: (n, n)."""
    carried = []
    for camera, a, b in zip(old.cameras, old.cam_from_rig, new.cam_from_rig, strict=True):
        turn = b.rotation @ a.rotation.T
        carry = _polar(a.translation, turn.T @ b.translation)[1]
        carried += [np.eye(len(camera.names) + 3), carry @ turn.T]
    return scipy.linalg.block_diag(*carried)


def _curvature(side: Stated, other: Estimate) -> FloatArray:
    """Covariance (n, n) of what linear propagation misses of a side's errors, by drawn ones.

    Of errors e and -e the mean is all curvature. Nothing where sigmas are small; of a scan that
    knows a baseline of 130 mm to 70 mm it is as large as the rest, without which it found drift.
    """
    middle = _apart(other, side.estimate)
    total = np.zeros((len(middle), len(middle)))
    rng = np.random.default_rng(SEED)
    for _ in range(DRAWS if side.covariance.names else 0):
        error = side.root @ rng.standard_normal(len(side.root))
        both = [
            _apart(other, changed(side.estimate, side.covariance.names, sign * error))
            for sign in (1, -1)
        ]
        missed = (both[0] + both[1]) / 2 - middle
        total += np.outer(missed, missed) / DRAWS
    return total


def _as_twists(side: Stated, names: Sequence[str]) -> FloatArray:
    return cross_covariance(poses_as(side.covariance, side.estimate, "left_twist"), names, names)


def _polar(old: FloatArray, new: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How a baseline (3,) changed, along it and across, and what carries changes of the new one
    (3, 3) to the old.

    A measured baseline of 200 mm is known to 0.1 mm, its direction by few frames to 7 mm: a turn
    by three sigmas shortens it by a millimetre along where it was. Length (its logarithm) and
    direction have no such curvature.
    """
    lengths = np.linalg.norm(old), np.linalg.norm(new)
    if min(lengths) <= LEAST_BASELINE * max(lengths) or max(lengths) == 0:
        return new - old, np.eye(3)
    u, w = old / lengths[0], new / lengths[1]
    axis = np.cross(u, w)
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, u @ w)
    turn = axis * (angle / sine if sine > 0 else 1.0)
    along = np.log(lengths[1] / lengths[0])
    moved: FloatArray = lengths[0] * (along * u + np.cross(turn, u))
    return moved, lengths[0] / lengths[1] * exp_rotation(-turn)


def _between(a: Camera, b: Camera) -> Camera:
    # Halfway, derivatives leave out nothing of second order.
    return replace(a, params=(a.params + b.params) / 2)


# ---- lenses --------------------------------------------------------------------------------


def of_lenses(of: Changes, systematic_px: float) -> Iterator[Row]:
    """Each lens's groups by themselves, and all of it."""
    for camera, (lens, seen) in enumerate(zip(of.estimate.cameras, of.pictures, strict=True)):
        groups: list[tuple[Tested, list[int]]] = [
            (group, columns) for group, columns in lens_columns(lens) if group in of.freed[camera]
        ]
        together = [column for _, columns in groups for column in columns]
        if len(groups) > 1:
            groups.append(("lens", together))
        for group, columns in groups:
            rows = [of.lens_of(camera)[column] for column in columns]
            change, R, square = of.change[rows], seen.of_lens(columns), np.ix_(rows, rows)
            cov = of.cov[square]
            n_groups = len(groups) - 1 if group == "lens" else 1
            allowed = share(systematic_px, len(rows), n_groups) * np.eye(len(rows))
            cov_px = R @ cov @ R.T + allowed
            yield Row(
                (camera,), group, tuple(lens.names[column] for column in columns), change,
                np.sqrt(np.maximum(np.diag(cov), 0.0)), R @ change, cov_px,
                degrees(cov_px, [Guess(g.cov[square], g.nu).carried(R) for g in of.guesses]),
            )  # fmt: skip


# ---- places --------------------------------------------------------------------------------


@dataclass(frozen=True)
class PlaceTests:
    """How all cameras' places changed, and what it takes to say so in radians and lengths."""

    places: Places
    cov_stated: FloatArray  # (6 n, 6 n) px^2, nothing allowed beside it
    pictures: tuple[Picture, ...]
    freed: Freed

    @property
    def suspects(self) -> list[int]:
        """Cameras whose place was free."""
        return [i for i, groups in enumerate(self.freed) if groups & set(GROUPS[3:])]

    def rows(self, moved: Collection[int] = ()) -> Iterator[Row]:
        """Each camera in the frame of those others that did not move, then all together."""
        n = self.places.n_cameras
        if n == 1 or not self.suspects:
            return
        for camera in range(n) if n > 2 else moved or (1,):
            of = (camera,) if n > 2 or moved else (0, 1)
            free = frozenset[Group]().union(*(self.freed[i] for i in of))
            left = self.places.in_frame_of(set(range(n)) - {camera} - set(moved))
            for part, group in enumerate(GROUPS[3:]):
                if group in free:
                    yield self._row(of, group, left, 6 * camera + 3 * part)
        free_px, basis = self.places.without_frames(range(n))
        cov_px, nu = self._carried(basis.T)
        yield Row(
            tuple(range(n)), "places", (), np.zeros(0), np.zeros(0), free_px / n**0.5,
            cov_px / n, nu,
        )  # fmt: skip

    def _carried(self, part: FloatArray) -> tuple[FloatArray, float]:
        """Covariance (m, m) and its degrees of freedom of what a part (m, 6 n) takes of all."""
        cov = part @ self.places.cov @ part.T
        return cov, degrees(cov, [one.carried(part) for one in self.places.guesses])

    def _row(self, of: tuple[int, ...], group: Group, left: FloatArray, first: int) -> Row:
        part = left[first : first + 3]
        seen = self.pictures[first // 6]
        # The centre moves against the twist: cam_from_rig takes points to the camera.
        in_px = seen.turn if group == "rotation" else -seen.move
        natural = np.linalg.inv(in_px)
        change_px = part @ self.places.change
        sigma = np.sqrt(np.diag(natural @ part @ self.cov_stated @ part.T @ natural.T))
        return Row(of, group, AXES, natural @ change_px, sigma, change_px, *self._carried(part))


def of_places(of: Changes, systematic_px: float, scale: bool) -> PlaceTests:
    """Where cameras point, and their places; scale: the size of the rig is taken out."""
    n = len(of.pictures)
    in_px, roots = np.zeros((6 * n, len(of.names))), []
    for camera, seen in enumerate(of.pictures):
        lens = of.lens_of(camera)
        first, rows = lens[-1] + 1, slice(6 * camera, 6 * camera + 6)
        root = np.zeros((6, 6))
        root[:3, :3], root[3:, 3:] = seen.turn, seen.move
        in_px[rows, first : first + 6] = root
        in_px[rows, lens[0] : first] = root[:, :3] @ seen.pointing
        roots.append(root)
    cov = in_px @ of.cov @ in_px.T
    allowed = np.repeat([share(systematic_px, 3), share(OF_PLACE * systematic_px, 3)], 3)
    places = Places(
        in_px @ of.change,
        cov + np.diag(np.tile(allowed, n)),
        tuple(one.carried(in_px) for one in of.guesses),
        frame_changes(of.estimate.cam_from_rig, roots, scale),
    )
    return PlaceTests(places, cov, of.pictures, of.freed)
