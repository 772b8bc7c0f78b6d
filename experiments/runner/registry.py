"""The studies there are."""

from __future__ import annotations

import importlib
from typing import Any

from experiments.runner.protocol import Study
from sfm_calib.errors import nearest

# Files under experiments/ that have a STUDY.
STUDIES = (
    "aleatory_epistemic",
    "bundle_vs_zhang",
    "calibrations",
    "coverage",
    "depth_camera_cabin",
    "depth_error",
    "drift",
    "example",
    "planar_pose",
    "robust_losses",
    "targetless_vs_target",
    "views_needed",
    "weak_geometry",
    "wrong_starts",
)


def check_name(name: str) -> None:
    """Raises ValueError with the nearest valid name."""
    if name not in STUDIES:
        raise ValueError(f"there is no study {name!r}; {nearest(name, STUDIES)}")


def study_of(name: str) -> Study[Any]:
    """The study in experiments/NAME.py; its docstring is `about(name)`."""
    study: Study[Any] = importlib.import_module(f"experiments.{name}").STUDY
    return study


def about(name: str) -> str:
    """Question, method, expectation and source, as the study's file says them."""
    return (importlib.import_module(f"experiments.{name}").__doc__ or "").strip()
