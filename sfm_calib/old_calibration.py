"""The old calibration of a rig, in a scan's terms: names, units, image sizes and sigmas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from graphs.compare import Stated
from graphs.compare_rig import pair_place
from graphs.covariance import NOTHING
from graphs.drift_picture import assumed_covariance
from sfm_calib.compare_sides import renamed
from sfm_calib.config import BaselineConfig, RigConfig
from sfm_calib.drift import DriftOptions
from sfm_calib.errors import CalibrationError, nearest
from sfm_calib.formats import NO_SIZE, CameraRig
from sfm_calib.images import Scan
from sfm_calib.lifted import lifted
from sfm_calib.nominal import LONE_LENS, RIG_LENS, lens_said
from sfm_calib.partial import reference_of, seen_from
from sfm_calib.prior import checked
from sfm_calib.uncertainty import Unit

LEAST_RELATIVE = 1e-6  # sigma of a baseline that a file without sigmas, or a truth, gives


@dataclass(frozen=True)
class OldCalibration:
    """What a scan is told of an old calibration; all its cameras, also those the scan lacks."""

    rig: CameraRig  # names as the scan's; in metres, else in units of its longest baseline
    unit: Unit | None  # None: one camera, or no place is known
    assumed: bool  # its sigmas are: the file states none
    notes: tuple[str, ...]

    @property
    def stated(self) -> Stated:
        """Its values with the covariance that it states or is assumed to have."""
        return self.rig.stated

    @property
    def own(self) -> Stated:
        """With what it states itself: nothing, where its sigmas are assumed."""
        return Stated(self.stated.estimate, NOTHING) if self.assumed else self.stated

    def common(self, names: Sequence[str]) -> tuple[str, ...]:
        """Of these cameras, those that it has."""
        return tuple(name for name in names if name in self.rig.names)

    def reference(self, names: Sequence[str]) -> str:
        """Whose frame is the rig's in a scan of these cameras: its own reference's, if there."""
        own = reference_of(self.rig)
        return own if own in names else self.common(names)[0]

    def baseline(self, names: Sequence[str]) -> BaselineConfig | None:
        """Its longest distance between two of these cameras, where it has metres."""
        stated, known = self.stated, self.rig.names
        centres = [t.inverse.translation for t in stated.estimate.cam_from_rig]
        lengths = {
            (a, b): float(np.linalg.norm(centres[known.index(a)] - centres[known.index(b)]))
            for a, b in combinations(self.common(names), 2)
        }
        if self.unit != "m" or not any(lengths.values()):
            return None
        a, b = max(lengths, key=lambda pair: lengths[pair])
        sigma = pair_place(stated, stated, (known.index(a), known.index(b))).sigma_baselines[0]
        length = lengths[a, b]
        return BaselineConfig(
            cameras=(a, b), length_m=length, sigma_m=max(sigma, LEAST_RELATIVE * length)
        )


def old_calibration(
    read: CameraRig,
    scan: Scan,
    config: RigConfig,
    cameras: Sequence[str],
    options: DriftOptions,
) -> OldCalibration:
    """An old calibration as it was read, for a scan of its rig.

    cameras: `name in OLD=name in the scan`, where the names do not tell. options: how right a file
    without sigmas is taken to be. A lens that the configuration gives is taken where it holds the
    old one; where it gives none, a richer one in place of one too simple for a scan. Raises
    CalibrationError where no camera is in both, where image sizes differ or nothing tells them, and
    where it does not say how its cameras sit.
    """
    named, notes = _named_as(read, scan.cameras, cameras)
    rig = checked(named, dict(zip(scan.cameras, scan.sizes, strict=True)))
    rig, of_sizes = _sized(rig, scan)
    rig, unit = _in_unit(rig)
    if unit == "baseline" and read.unit == "unknown":
        notes += (f"{rig.path} states no unit of length (--metres says what it is)",)
    assumed = not rig.states_sigmas
    for name in scan.cameras:
        wanted = lens_said(config, name)
        if wanted is None and assumed:  # who states sigmas has chosen the lens on evidence
            wanted = RIG_LENS if len(scan.cameras) > 1 else LONE_LENS
        if wanted is not None:
            distance = options.range(unit or "m")
            rig, told = lifted(rig, wanted, (name,), options.old_sigma_px, distance)
            notes += told
    if assumed:
        reference = rig.names.index(reference_of(rig))
        side = seen_from(rig.stated, rig.names[reference])
        covariance = assumed_covariance(
            side.estimate, options.old_sigma_px, options.range(unit or "m"), reference
        )
        rig = replace(rig, covariance=covariance, cam_from_rig=side.estimate.cam_from_rig)
    return OldCalibration(rig, unit, assumed, (*rig.notes, *notes, *of_sizes))


def _named_as(
    read: CameraRig, names: Sequence[str], wanted: Sequence[str]
) -> tuple[CameraRig, tuple[str, ...]]:
    """With its cameras called as the scan calls them: as wanted, by name, or else by order."""
    called = dict(zip(read.names, read.names, strict=True))
    for entry in (one for each in wanted for one in each.split(",")):
        old, equals, new = entry.partition("=")
        if not equals:
            raise CalibrationError(f"--cameras {entry}: say NAME IN OLD=NAME IN THE SCAN")
        for name, known, whose in ((old, read.names, str(read.path)), (new, names, "the scan")):
            if name not in known:
                raise CalibrationError(
                    f"--cameras {entry}: {whose} has no camera {name!r}: {nearest(name, known)}"
                )
        called[old] = new
    notes: tuple[str, ...] = ()
    if not wanted and not set(read.names) & set(names) and len(read.names) == len(names):
        called = dict(zip(read.names, names, strict=True))
        said = ", ".join(f"{old} = {new}" for old, new in called.items())
        notes = (f"cameras are called otherwise in the scan: matched by their order, {said}",)
    if len(set(called.values())) < len(called):
        twice = next(n for n in called.values() if list(called.values()).count(n) > 1)
        both = " and ".join(old for old, new in called.items() if new == twice)
        raise CalibrationError(
            f"--cameras {' '.join(wanted)}: two cameras of OLD are {twice} of the scan, {both}: "
            "say of each which it is (those not named keep their names)"
        )
    return renamed(read, list(called.values())), notes


def _sized(rig: CameraRig, scan: Scan) -> tuple[CameraRig, tuple[str, ...]]:
    """With the scan's image size, if it has but one, for cameras of neither size nor images.

    Raises CalibrationError where it has several.
    """
    lost = [camera.name for camera in rig.cameras if camera.size == NO_SIZE]
    if not lost:
        return rig, ()
    if len(set(scan.sizes)) > 1:
        raise CalibrationError(
            f"{rig.path} does not say how large the images of {lost[0]} are, and the scan has none "
            "of it: add the size, or scan with that camera too"
        )
    size = scan.sizes[0]
    cameras = tuple(replace(c, size=size) if c.name in lost else c for c in rig.cameras)
    note = f"images of {', '.join(lost)} are taken to be of {size[0]} x {size[1]} px, as the scan's"
    return replace(rig, cameras=cameras), (note,)


def _in_unit(rig: CameraRig) -> tuple[CameraRig, Unit | None]:
    """In metres where it has them; else its longest baseline is 1 long."""
    if rig.cam_from_rig is None or len(rig.cameras) == 1:
        return rig, None
    if rig.unit == "m":
        return rig, "m"
    centres = np.array([t.inverse.translation for t in rig.cam_from_rig])
    longest = float(np.linalg.norm(centres[:, None] - centres[None], axis=-1).max())
    if longest <= 0:
        return rig, None
    return replace(rig.metric(1 / longest), unit="baseline"), "baseline"


def with_scale_of(config: RigConfig, known: BaselineConfig | None) -> RigConfig:
    """The configuration with a length of the old calibration, where it measures none itself."""
    if known is None or config.scale.measured:
        return config
    scale = config.scale.model_copy(update={"baseline": (known,)})
    return config.model_copy(update={"scale": scale})
