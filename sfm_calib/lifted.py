"""Old calibrations of lenses too simple to solve a scan with, in a lens that holds them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import scipy.linalg

from graphs.compare_rig import as_lens, holds
from graphs.covariance import Covariance
from graphs.drift_picture import assumed_covariance
from graphs.lenses import PARAMETER_NAMES, LensName
from graphs.propagation import lens_names, marginal
from sfm_calib.formats import CameraRig
from sfm_calib.partial import reference_of


def lifted(
    rig: CameraRig, least: LensName, cameras: Sequence[str], sigma_px: float, distance: float
) -> tuple[CameraRig, tuple[str, ...]]:
    """With those of `cameras` whose lens `least` holds in that one, and a note on each.

    What the simpler lens leaves out would be taken for drift: on rectified images of a street, a
    pinhole is 3 % short in focal length, and eight times its sigma. Coefficients that are new are
    zero, right to `sigma_px` in the picture of points at `distance`, where the rest has sigmas.
    """
    side, notes, new_names = rig.stated, [], []
    for index, camera in enumerate(rig.cameras):
        simpler = camera.lens != least and holds(least, camera.lens)
        if not simpler or camera.name not in cameras:
            continue
        side = as_lens(side, index, least)[0]
        wider = side.estimate.cameras[index]
        new_names += [n for n in lens_names(wider) if n not in lens_names(camera)]
        more = " ".join(n for n in PARAMETER_NAMES[least] if n not in PARAMETER_NAMES[camera.lens])
        notes.append(
            f"{camera.name} is {camera.lens} in {rig.path}: solved as {least}, so that what its "
            f"images have of {more} is not taken for drift of the rest"
        )
    if not notes:
        return rig, ()
    covariance = side.covariance
    if rig.states_sigmas:
        reference = rig.names.index(reference_of(rig))
        every = assumed_covariance(side.estimate, sigma_px, distance, reference)
        added = marginal(every, new_names)
        kept = [i for i, name in enumerate(covariance.names) if name not in added.names]
        names = tuple(covariance.names[i] for i in kept)
        matrix = scipy.linalg.block_diag(covariance.matrix[kept][:, kept], added.matrix)
        covariance = Covariance((*names, *added.names), matrix)
    return replace(rig, cameras=side.estimate.cameras, covariance=covariance), tuple(notes)
