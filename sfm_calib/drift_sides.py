"""What of an old and a new calibration of a rig the drift test holds against each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from graphs.compare import Stated
from graphs.covariance import NOTHING, Covariance
from graphs.drift_picture import Group, lens_columns
from graphs.frames import Transform
from graphs.problem import PriorRig
from graphs.propagation import lens_names, marginal, pose_names
from graphs.refine import Refinement


def part_of(side: Stated, names: Sequence[str]) -> Stated:
    """These cameras of a calibration, in this order."""
    known = [camera.name for camera in side.estimate.cameras]
    places = [known.index(name) for name in names]
    of = [
        name
        for camera in (side.estimate.cameras[i] for i in places)
        for name in (*lens_names(camera), *pose_names(camera.name))
        if name in side.covariance.names
    ]
    estimate = replace(
        side.estimate,
        cameras=tuple(side.estimate.cameras[i] for i in places),
        cam_from_rig=tuple(side.estimate.cam_from_rig[i] for i in places),
    )
    return Stated(estimate, marginal(side.covariance, of) if of else NOTHING)


def without_lengths(side: Stated) -> Stated:
    """With its cameras in one place, which is known."""
    kept = [name for name in side.covariance.names if ".translation_" not in name]
    placed = tuple(Transform(t.rotation, np.zeros(3)) for t in side.estimate.cam_from_rig)
    known = marginal(side.covariance, kept) if kept else side.covariance
    return Stated(replace(side.estimate, cam_from_rig=placed), known)


def leaning_of(refinement: Refinement, model: Covariance) -> dict[tuple[str, Group], float]:
    """The largest share of belief in what is known of each group of each lens.

    model: the model's covariance of the result, without what errs together.
    """
    graph, sigma = refinement.graph, model.sigma
    shares: dict[tuple[str, Group], float] = {}
    for index, camera in enumerate(refinement.estimate.cameras):
        prior = graph.lens_priors[graph.layout.lens_of[index]]
        believed = np.diag(np.linalg.inv(prior.information()))
        for group, columns in lens_columns(camera):
            known = [(c, name) for c in columns if (name := lens_names(camera)[c]) in sigma]
            of = [float(sigma[name] ** 2 / believed[c]) for c, name in known if prior.free[c]]
            shares[camera.name, group] = min(max(of, default=0.0), 1.0)
    return shares


def freed_groups(
    side: Stated, prior: PriorRig, fixed: frozenset[str] = frozenset()
) -> Iterator[tuple[str, Group]]:
    """The groups of each camera of which anything was freed; fixed: what else was held.

    The reference moves where all others do: what is held of one of them says that it did not.
    """
    for camera in side.estimate.cameras:
        names = lens_names(camera)
        for group, columns in lens_columns(camera):
            if any(names[column] not in prior.held | fixed for column in columns):
                yield camera.name, group
    placed = [camera.name for camera in side.estimate.cameras if camera.name != prior.reference]
    of_place: tuple[tuple[Group, slice], ...] = (
        ("rotation", slice(0, 3)),
        ("translation", slice(3, 6)),
    )
    for group, part in of_place:
        free = [name for name in placed if not prior.held.issuperset(pose_names(name)[part])]
        yield from ((name, group) for name in free)
        if free == placed:
            yield prior.reference, group
