"""What a person sees in the terminal: progress on stderr, the result as a table on stdout."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from graphs.lenses import PARAMETER_NAMES
from sfm_calib.images import Progress as Report
from sfm_calib.report import TruthRow
from sfm_calib.result import Calibration

SUSPICIOUS_Z = 4.0


@contextmanager
def progress_bars() -> Iterator[Report]:
    """A bar a stage; plain lines where stderr is no terminal."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _plain_progress()
        return
    columns = (
        TextColumn("{task.description:<26}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console) as bars:
        tasks: dict[str, object] = {}

        def report(stage: str, done: int, total: int) -> None:
            for name, task in tasks.items():
                if name != stage:
                    bars.stop_task(task)  # type: ignore[arg-type]
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total or None)
            bars.update(tasks[stage], completed=done, total=total or None)  # type: ignore[arg-type]

        yield report


def _plain_progress() -> Report:
    """One line a stage, and one a tenth of it."""
    last: dict[str, int] = {}

    def report(stage: str, done: int, total: int) -> None:
        tenth = 10 * done // total if total else 0
        if last.get(stage) != tenth:
            last[stage] = tenth
            share = f" {done} of {total}" if total else ""
            print(f"{stage}{share}", file=sys.stderr, flush=True)

    return report


def print_result(calibration: Calibration, console: Console) -> None:
    """The parameters with their sigmas, and what is to be said of them."""
    for name, camera in calibration.cameras.items():
        table = Table(
            title=f"{name}  {camera.lens}  {camera.size[0]}x{camera.size[1]}  "
            f"{camera.n_images} images, {camera.n_observations} observations",
            title_justify="left",
        )
        for column in ("", "value", "sigma", "from priors"):
            table.add_column(column, justify="right" if column else "left")
        for parameter in PARAMETER_NAMES[camera.lens]:
            value, sigma = camera.params[parameter], camera.sigma.get(parameter, 0.0)
            share = camera.prior_share.get(parameter, 0.0)
            table.add_row(parameter, _number(value, sigma), _sigma(sigma), f"{share:.0%}")
        console.print(table)
    if len(calibration.cameras) > 1:
        console.print(_rig_table(calibration))
    solve, noise, verdict = calibration.solve, calibration.noise, calibration.verdict
    if solve and noise:
        console.print(
            f"{solve.n_images} images in {solve.n_frames} frames, {solve.n_points} points, "
            f"{solve.n_observations} observations ({solve.n_rejected} mismatches set aside); "
            f"noise {noise.sigma_px:.2f} px, sigmas widened {noise.inflation:.1f} x"
        )
    for weak in verdict.weak if verdict else ():
        console.print(f"weak: {weak.what} is decided by its prior; {weak.remedy}")
    for message in verdict.messages if verdict else ():
        console.print(f"note: {message}")


def _rig_table(calibration: Calibration) -> Table:
    unit = "m" if calibration.rig.metric else "baselines"
    table = Table(
        title=f"cam_from_rig  reference {calibration.rig.reference}  scale {calibration.rig.scale.source}",
        title_justify="left",
    )
    for column in ("", "rotation (wxyz)", "sigma deg", f"translation {unit}", "sigma"):
        table.add_column(column)
    for name, entry in calibration.rig.cam_from_rig.items():
        table.add_row(
            name,
            " ".join(f"{q:+.5f}" for q in entry.rotation_wxyz),
            " ".join(f"{s:.2g}" for s in entry.sigma_rotation_deg),
            " ".join(f"{t:+.4f}" for t in entry.translation),
            " ".join(f"{s:.2g}" for s in entry.sigma_translation),
        )
    return table


def print_comparison(rows: Sequence[TruthRow], console: Console) -> None:
    """Estimate, truth, error, sigma and z of each parameter."""
    table = Table(title="against the truth", title_justify="left")
    for column in ("", "estimate", "truth", "error", "sigma", "z"):
        table.add_column(column, justify="right" if column else "left")
    for row in rows:
        z = f"{row.z:+.1f}" if row.z == row.z else "-"
        style = "bold red" if abs(row.z) > SUSPICIOUS_Z else ""
        table.add_row(
            row.name,
            _number(row.estimate, row.sigma),
            _number(row.truth, row.sigma),
            f"{row.error:+.2g}",
            _sigma(row.sigma),
            z,
            style=style,
        )
    console.print(table)


def _number(value: float, sigma: float) -> str:
    """As many digits as the sigma makes meaningful."""
    if sigma <= 0:
        return f"{value:.6g}"
    digits = 0
    while digits < 9 and sigma * 10**digits < 2:
        digits += 1
    return f"{value:.{digits}f}"


def _sigma(sigma: float) -> str:
    return f"{sigma:.2g}" if sigma > 0 else "fixed"
