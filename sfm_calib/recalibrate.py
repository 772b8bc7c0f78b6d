"""The story of a recalibration: an old calibration and today's scan in; keep or replace out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from pydantic import BaseModel, ConfigDict, Field

from graphs.compare import Stated
from graphs.consider import Sensitivity, considered, cov_difference, sensitivity
from graphs.covariance import Covariance
from graphs.drift import Drift, drift
from graphs.drift_picture import GROUPS, Group, lens_columns
from graphs.drift_tests import Criteria
from graphs.joint_prior import shares_of_prior
from graphs.problem import PriorMode, Problem
from graphs.propagation import lens_names, marginal, pose_names
from graphs.refine import Refinement
from graphs.stated_covariance import CalibrationCovariance
from sfm_calib import result
from sfm_calib.cache import Cache
from sfm_calib.calibrate import (
    Outcome,
    Stopwatch,
    checked_scan,
    covariance_of,
    enough_placed,
    refusals,
    solve_problem,
)
from sfm_calib.config import RigConfig
from sfm_calib.formats import CameraRig
from sfm_calib.guided import map_with_prior
from sfm_calib.images import Progress
from sfm_calib.nominal import start_from_config
from sfm_calib.old_calibration import RANGE, OldCalibration, old_calibration, with_scale_of
from sfm_calib.partial import completed
from sfm_calib.prior import freed, prior_of, started, with_lenses
from sfm_calib.recalibration_record import Contribution, Recalibration
from sfm_calib.run import Given, Run
from sfm_calib.summary import summarise
