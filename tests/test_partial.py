"""Kept cameras: OLD's numbers and covariance untouched; frames, units and refusals; NEES."""

from __future__ import annotations

from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from synthetic.cameras import camera_of

from graphs.compare import Stated
from graphs.covariance import NOTHING, Covariance
from graphs.frames import FloatArray, Transform, exp_rotation, log_rotation
from graphs.pose_covariance import relative, rereferenced
from graphs.propagation import lens_names, marginal, pose_names
from sfm_calib.errors import CalibrationError
from sfm_calib.formats import CameraRig, LengthUnit
from sfm_calib.formats.ours import rig_of
from sfm_calib.partial import Completed, completed, in_longest_baseline, with_missing
from sfm_calib.recalibration_record import OldFile, Recalibration
from sfm_calib.report.rows import camera_tables
from sfm_calib.result import CameraResult, CamFromRig, Verdict, load_calibration, save_calibration
from sfm_calib.result import Covariance as CovarianceResult
from sfm_calib.terminal import print_result

NAMES = ("a", "b", "c", "d")
CENTRES = ((0.0, 0.0, 0.0), (0.3, 0.02, 0.0), (0.1, -0.2, 0.05), (-0.2, 0.1, 0.1))
LENS = camera_of("radial")


def true_rig(names: tuple[str, ...], reference: str, factor: float = 1.0) -> CameraRig:
    """Those of four cameras, in the frame of one."""
    turns = np.random.default_rng(3).normal(0, 0.3, (4, 3))
    placed = {
        name: Transform(exp_rotation(turn), -exp_rotation(turn) @ np.array(centre))
        for name, turn, centre in zip(NAMES, turns, CENTRES, strict=True)
    }
    rig = tuple((placed[n] @ placed[reference].inverse).scaled(factor) for n in names)
    rig = tuple(
        Transform.identity() if n == reference else t for n, t in zip(names, rig, strict=True)
    )
    cameras = tuple(replace(LENS, name=name) for name in names)
    return CameraRig(Path("old.json"), "made", cameras, rig, "m" if factor == 1 else "unknown")


def uncertain(rig: CameraRig, reference: str, seed: int, sigma: float = 1e-4) -> CameraRig:
    """With a full covariance; the reference's place is known."""
    names = [n for c in rig.cameras for n in lens_names(c)]
    names += [n for c in rig.names if c != reference for n in pose_names(c)]
    root = np.random.default_rng(seed).normal(size=(len(names), 2 * len(names))) / len(names) ** 0.5
    scale = np.array([sigma * (100 if n[-2:] in ("fx", "fy", "cx", "cy") else 1) for n in names])
    matrix = (scale[:, None] * root) @ (scale[:, None] * root).T
    return replace(rig, covariance=Covariance(tuple(names), matrix))


def erring(rig: CameraRig, rng: np.random.Generator) -> CameraRig:
    """With an error of its covariance."""
    root = Stated(rig.stated.estimate, rig.covariance).root
    return off_by(rig, root @ rng.normal(size=len(rig.covariance.names)))


def off_by(rig: CameraRig, error: FloatArray) -> CameraRig:
    """With an error in each parameter of its covariance."""
    by = dict(zip(rig.covariance.names, error.tolist(), strict=True))
    cameras, placed = [], []
    assert rig.cam_from_rig
    for camera, t in zip(rig.cameras, rig.cam_from_rig, strict=True):
        off = np.array([by[n] for n in lens_names(camera)])
        cameras.append(replace(camera, params=camera.params + off))
        turn = np.array([by.get(n, 0.0) for n in pose_names(camera.name)])
        placed.append(Transform(exp_rotation(turn[:3]) @ t.rotation, t.translation + turn[3:]))
    return replace(rig, cameras=tuple(cameras), cam_from_rig=tuple(placed))


def in_baseline(rig: CameraRig) -> CameraRig:
    """The longest baseline from the reference 1 long, and of no sigma."""
    side = in_longest_baseline(rig.stated)
    placed, covariance = side.estimate.cam_from_rig, side.covariance
    return replace(rig, cam_from_rig=placed, covariance=covariance, unit="baseline")


def error_of(found: Completed, true: CameraRig) -> FloatArray:
    """By the names of its covariance."""
    off: dict[str, float] = {}
    truth = {c.name: (c, t) for c, t in zip(true.cameras, true.cam_from_rig or (), strict=True)}
    estimate = found.stated.estimate
    for camera, t in zip(estimate.cameras, estimate.cam_from_rig, strict=True):
        wanted, placed = truth[camera.name]
        off |= dict(zip(lens_names(camera), camera.params - wanted.params, strict=True))
        turn = log_rotation(t.rotation @ placed.rotation.T)
        moved = [*turn, *(t.translation - placed.translation)]
        off |= dict(zip(pose_names(camera.name), moved, strict=True))
    return np.array([off[name] for name in found.stated.covariance.names])


def nees(error: FloatArray, covariance: Covariance) -> tuple[float, int]:
    """Squared error over the covariance, and its degrees of freedom: a unit baseline has none."""
    scale = np.sqrt(np.diag(covariance.matrix))
    free = scale > 1e-12
    scale = scale[free]
    whitened = covariance.matrix[np.ix_(free, free)] / scale / scale[:, None]
    values, vectors = np.linalg.eigh(whitened)
    kept = values > 1e-9 * values[-1]
    along = (vectors.T @ (error[free] / scale))[kept]
    return float((along**2 / values[kept]).sum()), int(kept.sum())


# ---- what is kept is OLD's -----------------------------------------------------------------


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.permutations(NAMES))
def test_kept_cameras_are_untouched_in_olds_frame(seed: int, order: list[str]) -> None:
    reference, missing = order[0], sorted(order[2:])
    old = uncertain(true_rig(NAMES, reference), reference, seed)
    new = uncertain(true_rig(tuple(order[:2]), order[1]), order[1], seed + 1)
    found = with_missing(new, old)
    assert found.kept == tuple(missing) and found.reference == found.tie == reference
    assert tuple(c.name for c in found.stated.estimate.cameras) == NAMES
    wanted = [n for c in old.cameras if c.name in missing for n in lens_names(c)]
    wanted += [n for c in missing for n in pose_names(c)]
    np.testing.assert_array_equal(
        marginal(found.stated.covariance, wanted).matrix, marginal(old.covariance, wanted).matrix
    )
    for index, name in enumerate(NAMES):
        if name in missing:
            assert found.stated.estimate.cameras[index] is old.cameras[index]
            assert (
                found.stated.estimate.cam_from_rig[index] is old.stated.estimate.cam_from_rig[index]
            )


def test_solved_cameras_are_the_scans_own_in_olds_frame() -> None:
    old = uncertain(true_rig(NAMES, "a"), "a", 1)
    new = uncertain(true_rig(("b", "a"), "b"), "b", 2)
    found = with_missing(new, old)
    placed, covariance = rereferenced(new.stated.estimate, new.covariance, 1)
    np.testing.assert_array_equal(
        found.stated.estimate.cam_from_rig[1].rotation, placed.cam_from_rig[0].rotation
    )
    own = (*lens_names(new.cameras[1]), *lens_names(new.cameras[0]), *pose_names("b"))
    np.testing.assert_allclose(
        marginal(found.stated.covariance, own).matrix, marginal(covariance, own).matrix, rtol=1e-9
    )


def test_nothing_missing_is_the_scans_own_with_new_cameras_last() -> None:
    old = uncertain(true_rig(("b", "a"), "a"), "a", 1)
    new = uncertain(true_rig(("a", "b", "c"), "a"), "a", 2)
    found = with_missing(new, old)
    assert (found.kept, found.added, found.scale) == ((), ("c",), None)
    assert tuple(c.name for c in found.stated.estimate.cameras) == ("b", "a", "c")
    names = found.stated.covariance.names
    np.testing.assert_array_equal(
        found.stated.covariance.matrix, marginal(new.covariance, names).matrix
    )
    assert set(names) == set(new.covariance.names)


def test_kept_cameras_follow_the_tie_and_not_the_camera_that_moved() -> None:
    old = uncertain(true_rig(NAMES, "a"), "a", 1)
    new = uncertain(true_rig(("a", "b", "c"), "a"), "a", 2)
    turned = Transform.exp(np.array([0.0, 0.02, 0.0]), np.array([0.01, 0.0, 0.0]))
    rig = new.cam_from_rig
    assert rig and old.cam_from_rig
    bumped = replace(new, cam_from_rig=(rig[0], *(t @ turned for t in rig[1:])))  # a has moved
    found = with_missing(bumped, old, unmoved=("c", "b"))
    assert (found.reference, found.tie) == ("a", "c")
    placed = found.stated.estimate.cam_from_rig
    np.testing.assert_allclose(
        (placed[3] @ placed[2].inverse).rotation,
        (old.cam_from_rig[3] @ old.cam_from_rig[2].inverse).rotation,
    )
    was, now = (relative(s.covariance, s.estimate, 3, 2).matrix for s in (old.stated, found.stated))
    np.testing.assert_allclose(now, was, atol=1e-12 * np.abs(was).max() + 1e-16)


# ---- errors are as stated ------------------------------------------------------------------

CASES: dict[str, tuple[str, tuple[str, ...], str, LengthUnit, LengthUnit]] = {
    "the same reference": ("a", ("a", "b"), "a", "m", "m"),
    "another reference": ("a", ("b", "a"), "b", "m", "m"),
    "without OLD's reference": ("a", ("c", "b"), "b", "m", "m"),
    "the scan has no metres": ("a", ("a", "b", "c"), "a", "m", "baseline"),
    "and is seen from elsewhere": ("b", ("a", "c"), "c", "m", "baseline"),
    "OLD has no metres": ("a", ("a", "c"), "c", "baseline", "m"),
    "neither has metres": ("a", ("a", "c", "b"), "a", "baseline", "baseline"),
    "one camera": ("a", ("b",), "b", "m", "unknown"),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_errors_are_as_large_as_stated(
    case: tuple[str, tuple[str, ...], str, LengthUnit, LengthUnit],
) -> None:
    of_old, names, of_new, unit_old, unit_new = case
    rng = np.random.default_rng(7)
    true_old = uncertain(true_rig(NAMES, of_old), of_old, 11)
    true_new = uncertain(true_rig(names, of_new), of_new, 12)
    total, degrees, trials = 0.0, 0, 60
    for _ in range(trials):
        old, new = erring(true_old, rng), erring(true_new, rng)
        old = in_baseline(old) if unit_old == "baseline" else replace(old, unit=unit_old)
        new = in_baseline(new) if unit_new == "baseline" else replace(new, unit=unit_new)
        found = with_missing(new, old)
        true = true_rig(NAMES, found.reference)
        if found.unit == "baseline":
            true = in_baseline(true)
        one, rank = nees(error_of(found, true), found.stated.covariance)
        total, degrees = total + one, degrees + rank
    assert found.unit == ("m" if "m" in (unit_old, unit_new) else "baseline")
    assert (found.scale is not None) == (unit_old != unit_new or unit_old != "m") or len(names) == 1
    assert total / degrees == pytest.approx(1.0, abs=4 * (2 / degrees) ** 0.5)


@pytest.mark.parametrize("which", [0, 1], ids=["of OLD", "of the scan"])
@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_a_small_error_of_one_side_moves_the_whole_as_stated(
    case: tuple[str, tuple[str, ...], str, LengthUnit, LengthUnit], which: int
) -> None:
    """A covariance of one direction is that of the difference that a step along it makes."""
    of_old, names, of_new, *units = case
    rigs = [uncertain(true_rig(NAMES, of_old), of_old, 11)]
    rigs.append(uncertain(true_rig(names, of_new), of_new, 12))
    known = rigs[which].covariance
    step = 0.01 * known.matrix[:, 0] / known.matrix[0, 0] ** 0.5  # correlated with all else
    for i, rig in enumerate(rigs):
        own = np.outer(step, step) if i == which else 0 * rig.covariance.matrix
        rigs[i] = replace(rig, covariance=Covariance(rig.covariance.names, own))

    def together(sign: float) -> Completed:
        moved = [off_by(rig, sign * step) if i == which else rig for i, rig in enumerate(rigs)]
        sides = [
            in_baseline(rig) if unit == "baseline" else replace(rig, unit=unit)
            for rig, unit in zip(moved, units, strict=True)
        ]
        return with_missing(sides[1], sides[0])

    found, ends = together(0.0), [together(sign).stated.estimate for sign in (1.0, -1.0)]
    less = CameraRig(Path("less"), "made", ends[1].cameras, ends[1].cam_from_rig, "m")
    difference = error_of(replace(found, stated=replace(found.stated, estimate=ends[0])), less) / 2
    stated = found.stated.covariance.matrix
    size = np.sqrt(np.maximum(np.diag(stated), 0.0))  # an exact zero may round below
    assert np.abs(difference).max() > 1e-7
    np.testing.assert_allclose(np.abs(difference), size, rtol=1e-3, atol=1e-5 * size.max())
    np.testing.assert_allclose(
        stated, np.outer(difference, difference), rtol=5e-3, atol=1e-9 * stated.max()
    )


# ---- refusals ------------------------------------------------------------------------------


def test_what_nothing_ties_is_refused() -> None:
    old = true_rig(("a", "b"), "a")
    with pytest.raises(CalibrationError, match=r"a, b and the scan c, d: no camera is in both"):
        with_missing(true_rig(("c", "d"), "c"), old)
    new = replace(true_rig(("a", "c"), "a"), unit="baseline")
    with pytest.raises(CalibrationError, match=r"no common unit .* \(a in common\): measure"):
        with_missing(new, old)
    with pytest.raises(CalibrationError, match=r"b sit|b cannot keep a place: give"):
        with_missing(true_rig(("a", "c"), "a"), replace(old, cam_from_rig=None))
    with pytest.raises(CalibrationError, match=r"^q cannot tie .*it has a"):
        with_missing(true_rig(("a", "c"), "a"), old, unmoved=("q",))


# ---- the result ----------------------------------------------------------------------------


def result_of(rig: CameraRig, reference: str):
    calibration = rig.calibration()
    sigma = rig.covariance.sigma
    cameras = {
        c.name: CameraResult(
            lens=c.lens, size=c.size, params=c.named(),
            sigma={p: sigma[f"{c.name}.{p}"] for p in c.names},
        )
        for c in rig.cameras
    }  # fmt: skip
    placed = {
        name: CamFromRig(
            rotation_wxyz=tuple(t.rotation_wxyz.tolist()), translation=tuple(t.translation.tolist())
        )
        for name, t in zip(rig.names, rig.cam_from_rig, strict=True)
    }
    covariance = CovarianceResult(
        names=rig.covariance.names, matrix=tuple(map(tuple, rig.covariance.matrix.tolist()))
    )
    whole = calibration.rig.model_copy(update={"cam_from_rig": placed, "reference": reference})
    update = {"cameras": cameras, "rig": whole, "covariance": covariance}
    return calibration.model_copy(update=update | {"verdict": Verdict(usable=True)})


def test_a_result_with_kept_cameras_is_written_marked(tmp_path: Path) -> None:
    old = uncertain(true_rig(NAMES, "a"), "a", 1)
    new = result_of(uncertain(true_rig(("b", "c"), "b"), "b", 2), "b")
    record = Recalibration(
        old=OldFile(path="old.json", sha256="a" * 64, format="made"),
        prior="start", freed=("everything",),
    )  # fmt: skip
    whole = completed(new, old, record)
    save_calibration(whole, tmp_path / "c.json")
    read = load_calibration(tmp_path / "c.json")
    assert read == whole
    assert read.recalibration and read.recalibration.kept == ("a", "d")
    assert {n: bool(c.kept_from) for n, c in read.cameras.items()} == {
        "a": True, "b": False, "c": False, "d": True,
    }  # fmt: skip
    assert read.cameras["a"].sigma["fx"] == old.covariance.sigma["a.fx"]
    assert read.cameras["a"].params == old.cameras[0].named()
    assert read.rig.reference == "b" and read.verdict
    assert "a, d not in the scan" in read.verdict.messages[-1]
    captions = {table.name: table.caption for table in camera_tables(read)}
    assert "kept as the old" in captions["a"] and "kept as the old" not in captions["b"]
    console = Console(file=StringIO(), width=100)
    print_result(read, console)
    assert "d: radial, 640 x 480 px, not in the scan: kept" in console.file.getvalue()
    found = with_missing(rig_of(new, Path("new")), old)
    np.testing.assert_allclose(read.covariance.matrix, found.stated.covariance.matrix)
    angle = read.rig.cam_from_rig["d"].sigma_rotation_deg[0]
    assert angle == pytest.approx(np.degrees(found.stated.covariance.sigma["d.rotation_x"]))


def test_a_lone_camera_takes_olds_metres() -> None:
    old = uncertain(true_rig(NAMES, "a"), "a", 1)
    alone = result_of(uncertain(true_rig(("a",), "a"), "a", 2), "a")
    new = alone.model_copy(update={"rig": alone.rig.model_copy(update={"metric": False})})
    record = Recalibration(
        old=OldFile(path="old.json", sha256="a" * 64, format="made"),
        prior="full", freed=("intrinsics",),
    )  # fmt: skip
    rig = completed(new, old, record).rig
    assert rig.metric and rig.scale.source == "the old calibration"
    assert rig.scale.sigma_relative == pytest.approx(1.4e-4 / 0.3, rel=0.5)


def test_a_kept_camera_of_a_file_without_sigmas_states_none() -> None:
    old = true_rig(NAMES, "a")
    new = uncertain(true_rig(("a", "b"), "a"), "a", 2)
    found = with_missing(new, old)
    assert set(found.stated.covariance.names) == set(new.covariance.names)
    assert old.covariance is NOTHING
