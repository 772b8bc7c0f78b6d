"""Do sources of scale that contradict each other show, and none that agree?

Question: a stereo rig on a car has a known baseline, and a satellite and inertial receiver of its
own that measured its path. Do the two agree, and is a baseline that is given 3 % too long found
out? Method: the real scan is calibrated with the baseline alone, and beside one distance of the
path or five of them, with the baseline as it is and too long; the ledger of each. Expectation: |z|
below 3 with the right baseline; above, and the baseline named, with the wrong one.
Run: python -m experiments.scale_ledger FOLDER
FOLDER holds scan/left, scan/right and poses.txt (world_from_left, a row of 3x4 a frame, in metres).
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from graphs.frames import FloatArray
from sfm_calib.cache import Cache
from sfm_calib.calibrate import calibrate
from sfm_calib.config import RigConfig, ScaleConfig
from sfm_calib.result import Calibration

BASELINE_M, BASELINE_SIGMA_M = 0.537, 0.001  # known to the last digit that is given
TOO_LONG = 1.03
# Of one position in poses.txt, along the path. The makers of such receivers promise 5 cm under an
# open sky; positions scatter by 3 cm (rms) about the path that the images give, once its size and
# place are taken out, and by 8 cm in the first frame.
POSITION_SIGMA_M = 0.05
# Frames, as shares of the scan: no two distances have an end in common, for errors of their own.
PAIRS = ((0.0, 1.0), (0.08, 0.92), (0.16, 0.8), (0.24, 0.7), (0.36, 0.6))


@dataclass(frozen=True)
class Case:
    """What is said to be known of the rig's size."""

    name: str
    baseline_m: float
    distances: int


CASES = (
    Case("the baseline alone", BASELINE_M, 0),
    Case("and one distance", BASELINE_M, 1),
    Case("and five distances", BASELINE_M, len(PAIRS)),
    Case("3 % too long, one distance", TOO_LONG * BASELINE_M, 1),
    Case("3 % too long, five distances", TOO_LONG * BASELINE_M, len(PAIRS)),
)


def positions(path: Path) -> FloatArray:
    """Where the left camera was (n_frames, 3)."""
    return np.loadtxt(path).reshape(-1, 3, 4)[:, :, 3]


def scale_of(case: Case, places: FloatArray, names: Sequence[str]) -> ScaleConfig:
    """The case as rig.yaml would have it; names: of the frames."""
    frames = []
    for pair in PAIRS[: case.distances]:
        a, b = (round(share * (len(places) - 1)) for share in pair)
        length_m = float(np.linalg.norm(places[b] - places[a]))
        sigma_m = 2**0.5 * POSITION_SIGMA_M
        frames.append({"between": [names[a], names[b]], "length_m": length_m, "sigma_m": sigma_m})
    baseline = {
        "cameras": ["left", "right"], "length_m": case.baseline_m, "sigma_m": BASELINE_SIGMA_M,
    }  # fmt: skip
    return ScaleConfig.model_validate({"baseline": baseline, "frames": frames})


def ledgers(
    folder: Path, cache: Cache, cases: Sequence[Case] = CASES
) -> Iterator[tuple[Case, Calibration]]:
    """Each case calibrated, from one mapping of the scan."""
    places = positions(folder / "poses.txt")
    names = sorted(path.stem for path in (folder / "scan" / "left").iterdir())
    for case in cases:
        config = RigConfig(scale=scale_of(case, places, names))
        yield case, calibrate(folder / "scan", config, cache, _told).calibration


def _told(stage: str, done: int, total: int) -> None:
    if done in (0, total):
        print(f"{stage} {done} of {total}", file=sys.stderr)


def show(case: Case, calibration: Calibration, console: Console) -> None:
    """A row a source, and what the verdict says of them."""
    table = Table(title=case.name)
    for column in ("", "measured m", "sigma", "found", "by the others", "sigma", "z", "p"):
        table.add_column(column, justify="right" if column else "left", no_wrap=True)
    for entry in calibration.rig.scale.ledger:
        told = entry.predicted_by_others_m, entry.sigma_predicted_m, entry.z, entry.p_value
        forms = (".4f", ".4f", "+.2f", ".2g")
        table.add_row(
            entry.what + (" (suspect)" if entry.suspect else ""),
            f"{entry.measured_m:.4f}", f"{entry.sigma_m:.4f}", f"{entry.estimated_m:.4f}",
            *("-" if x is None else f"{x:{form}}" for x, form in zip(told, forms, strict=True)),
        )  # fmt: skip
    console.print(table)
    for message in calibration.verdict.messages if calibration.verdict else ():
        if "compromise" in message:
            console.print(message, soft_wrap=True)


@dataclass(frozen=True)
class Options:
    """Do sources of scale that contradict each other show, and none that agree?"""

    folder: Annotated[Path, tyro.conf.Positional]
    """With scan/left, scan/right and poses.txt."""
    out: Path = Path("out/scale_ledger")
    """Where features, matches and models are kept."""


def main(options: Options) -> list[Calibration]:
    """Print a table a case; returns their results."""
    console = Console(width=None if sys.stdout.isatty() else 130, markup=False, highlight=False)
    found = []
    for case, calibration in ledgers(options.folder, Cache(options.out / "cache")):
        show(case, calibration, console)
        found.append(calibration)
    return found


if __name__ == "__main__":
    main(tyro.cli(Options))
