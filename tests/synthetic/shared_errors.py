"""Errors that observations share: those of frames, of tracks, of parts of the image plane."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from graphs.problem import Problem


def sheared(problem: Problem, sigma: float, seed: int) -> Problem:
    """Both images of a frame sheared and stretched by a little of its own: a shared error."""
    rng = np.random.default_rng(seed)
    shear = sigma * rng.standard_normal((len(problem.frame_names), 2, 2))
    seen = problem.observations
    centres = np.array([camera.centre for camera in problem.initial.cameras])[seen.camera]
    moved = np.einsum("nij,nj->ni", shear[seen.frame], seen.pixels - centres)
    return replace(problem, observations=replace(seen, pixels=seen.pixels + moved))


def drifting(problem: Problem, sigma_px: float, seed: int) -> Problem:
    """Every track pulled off its corner bit by bit, each its own way: a shared error."""
    seen = problem.observations
    pull = sigma_px * np.random.default_rng(seed).standard_normal((len(problem.initial.points), 2))
    middle = (len(problem.frame_names) - 1) / 2
    moved = pull[seen.point] * (seen.frame / middle - 1)[:, None]
    return replace(problem, observations=replace(seen, pixels=seen.pixels + moved))


def misfit(problem: Problem, sigma_px: float, seed: int) -> Problem:
    """Features of each camera moved by a wavy field of its image: a lens that is not ours."""
    rng, seen = np.random.default_rng(seed), problem.observations
    moved = np.zeros_like(seen.pixels)
    for index, camera in enumerate(problem.initial.cameras):
        rows = seen.camera == index
        waves = 2 * np.pi * rng.uniform(1, 3, (12, 2)) / camera.size
        phases = seen.pixels[rows] @ waves.T + rng.uniform(0, 2 * np.pi, 12)
        moved[rows] = sigma_px * np.sqrt(2 / 12) * np.sin(phases) @ rng.standard_normal((12, 2))
    return replace(problem, observations=replace(seen, pixels=seen.pixels + moved))
