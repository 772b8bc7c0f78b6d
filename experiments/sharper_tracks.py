"""How much sharper than SIFT are matched patches, and how much of that gets into the calibration?

Question: with raw SIFT, refined SIFT (`--refine`), SIFT found in images of half the size and then
refined, and learned features raw and refined: how noisy are the observations in truth, how far off
are focal lengths, principal points and places, do the stated sigmas hold, and what does it take?
Method: each kind of tracks calibrates the same scans, as `sfm-calib calibrate` does. Rendered ones
have a truth: the noise is that of the observations about their points, triangulated by the true
cameras in their true places, robustly. Real ones (configs/sharper_tracks_real.yaml) have
references, and halves of the frames that are calibrated apart, drawn by the seed. Ratios are
raw SIFT's rms over the other's, a geometric mean over scans; standard errors leave out one trial
after the other, and nothing is decided where they reach over what is required. Other seeds of a
real scan draw other halves and map it anew, and have none. Each stage is
timed where a trial did it, and not where it found it done.
Expectation: refined SIFT on rendered scans has a true noise at least 2.5 times smaller, errors of
focal length and principal point at least 2 times smaller, and NEES of 0.8 to 1.3. On real scans
sigma_px and the difference of halves are at least 1.5 times smaller, and differences from the
references no larger (or within the reference's own sigma). Features of half size and refinement
take no longer than features of full size.
Source: least-squares matching: Gruen, Adaptive least squares correlation, 1985; Lindenberger,
Sarlin, Larsson, Pollefeys, Pixel-Perfect Structure-from-Motion, ICCV 2021.
Run: sfm-calib run configs/studies/sharper_tracks.yaml -o out/sharper_tracks
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from experiments.calibrations import inputs as calibration_inputs
from experiments.runner.protocol import Study
from experiments.sharper_answer import answer
from experiments.sharper_trial import SharperOptions, SharperTrial, trial


def inputs(options: SharperOptions) -> Sequence[Path]:
    """Scan, rig.yaml, the reference's file, and weights of networks."""
    weights = options.said.get("weights")
    return (*calibration_inputs(options), *([Path(weights)] if weights else ()))


STUDY: Study[SharperOptions] = Study(SharperTrial, trial, answer, inputs, folder=True)
