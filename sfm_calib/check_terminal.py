"""What a person sees of a check: the numbers beside good ones, what is lacking, and a verdict."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rich.console import Console
from rich.table import Table

from sfm_calib.check import CameraCheck, ScanCheck, Seen
from sfm_calib.coverage_findings import (
    FEW_SHARED,
    GOOD_FRAMES,
    LEAST_COVERED,
    LEAST_DEPTH_RATIO,
    LEAST_PARALLAX_DEG,
    LEAST_ROLL_DEG,
    LEAST_TURN_DEG,
    MOST_FORWARD,
)
from sfm_calib.findings import BLURRED_PX, Finding
from sfm_calib.report.digits import with_digits

CAMERAS_A_TABLE = 3  # side by side in 80 columns
UNKNOWN = "-"
FARTHEST = 100  # times the nearest: beyond, it makes no difference
SHARP_PX = 0.5  # finer edges are not told apart: thin lines look sharper than edges do
CONCLUSIONS = {
    "good": "this scan can calibrate this rig",
    "doubtful": "a calibration will run, but what is named above will be known poorly; add "
    "such views, or see from its sigmas whether they will do",
    "cannot": "this scan cannot calibrate this rig; what is named above has to be mended first",
}

# What a camera saw and how it moved: name, how to write it, and what is good.
ROWS: tuple[tuple[str, Callable[[Seen], str], str], ...] = (
    ("points an image", lambda s: f"{s.per_image[0]}", ""),
    ("image covered", lambda s: f"{s.covered:.0%}", f"{LEAST_COVERED:.0%}"),
    ("corners reached", lambda s: f"{s.corners.count(True)} of {_corners(s)}", "all"),
    ("tilted up and down", lambda s: f"{s.rotation_deg[0]:.0f} deg", f"{LEAST_TURN_DEG:.0f} deg"),
    ("turned to the sides", lambda s: f"{s.rotation_deg[1]:.0f} deg", f"{LEAST_TURN_DEG:.0f} deg"),
    ("rolled, tipped aside", lambda s: f"{s.rotation_deg[2]:.0f} deg", f"{LEAST_ROLL_DEG:.0f} deg"),
    ("moved along its view", lambda s: f"{s.path_share[2]:.0%}", f"< {MOST_FORWARD:.0%}"),
    ("near to far points", lambda s: _distances(s), f"1 to {LEAST_DEPTH_RATIO:g}"),
    ("angle between views", lambda s: _parallax(s), f"{LEAST_PARALLAX_DEG:g} deg"),
)


def print_check(check: ScanCheck, console: Console) -> None:
    """Tables, findings with their remedies, and the verdict as the last line."""
    names = list(check.cameras)
    for start in range(0, len(names), CAMERAS_A_TABLE):
        some = names[start : start + CAMERAS_A_TABLE]
        console.print(_table({name: check.cameras[name] for name in some}))
    for name, camera in check.cameras.items():
        if camera.params:
            _print(console, f"{name} by a quick solve: {_lens(camera)}")
    for message in check.messages:
        _print(console, f"note: {message}")
    # Sorted by severity already; in it, one topic of all cameras together.
    topics = list(dict.fromkeys((each.severity, each.topic) for each in check.findings))
    for severity, topic in topics:
        group = [
            each for each in check.findings if (each.severity, each.topic) == (severity, topic)
        ]
        _print_findings(group, f"{severity}: {topic}", console)
    _print(console, f"verdict: {_verdict(check)}")


def _print(console: Console, text: str) -> None:
    console.print(text, soft_wrap=not console.is_terminal)


def _table(cameras: dict[str, CameraCheck]) -> Table:
    table = Table()
    table.add_column("", no_wrap=True)
    for name in cameras:
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("good from", justify="right", no_wrap=True)
    placed = [f"{c.seen.n_placed if c.seen else 0} of {c.n_images}" for c in cameras.values()]
    table.add_row("images placed", *placed, f"{GOOD_FRAMES}")
    if all(camera.seen is not None for camera in cameras.values()):
        for title, cell, good in ROWS:
            table.add_row(title, *(cell(c.seen) for c in cameras.values() if c.seen), good)
        if any(c.seen and c.seen.shared_at_once for c in cameras.values()):
            shared = [_shared(c.seen) for c in cameras.values() if c.seen]
            table.add_row("shared at one moment", *shared, f"{FEW_SHARED}")
    blur = [_blur(camera.edge_px) for camera in cameras.values()]
    table.add_row("blur of sharp edges", *blur, f"< {BLURRED_PX:g} px")
    table.add_row("blurred images", *(f"{len(c.blurred)}" for c in cameras.values()), "0")
    table.add_row("verdict", *(c.verdict for c in cameras.values()), "")
    return table


def _corners(seen: Seen) -> int:
    """Corners that the lens lights."""
    return sum(corner is not None for corner in seen.corners)


def _blur(edge_px: float | None) -> str:
    if edge_px is None:
        return UNKNOWN
    return f"< {SHARP_PX} px" if edge_px < SHARP_PX else f"{edge_px:.1f} px"


def _distances(seen: Seen) -> str:
    if not (seen.near and seen.far):
        return UNKNOWN
    ratio = seen.far / seen.near
    return f"1 to {ratio:.1f}" if ratio < FARTHEST else f"1 to {FARTHEST}"


def _parallax(seen: Seen) -> str:
    return UNKNOWN if seen.parallax_deg is None else f"{seen.parallax_deg[1]:.1f} deg"


def _shared(seen: Seen) -> str:
    """Points in common with the camera that overlaps most."""
    return f"{max(seen.shared_at_once.values())}"


def _lens(camera: CameraCheck) -> str:
    """Focal length and principal point with their sigmas."""
    parts = []
    for name in ("fx", "fy", "cx", "cy"):
        sigma = camera.sigma.get(name, 0.0)
        spread = f" +- {with_digits(sigma, sigma)}" if sigma else ""
        parts.append(f"{name} {with_digits(camera.params[name], sigma)}{spread}")
    return ", ".join(parts) + " px"


def _print_findings(group: Sequence[Finding], title: str, console: Console) -> None:
    """One topic: what each camera has to say of it, and each remedy once."""
    _print(console, title)
    for what in dict.fromkeys(each.what for each in group):
        names = ", ".join(each.camera for each in group if each.what == what and each.camera)
        _print(console, f"  {names}: {what}" if names else f"  {what}")
    for remedy in dict.fromkeys(each.remedy for each in group if each.remedy):
        _print(console, f"  -> {remedy}")


def _verdict(check: ScanCheck) -> str:
    which = [name for name, camera in check.cameras.items() if camera.verdict == check.verdict]
    some = f" ({', '.join(which)})" if len(which) < len(check.cameras) else ""
    return f"{check.verdict}{some}: {CONCLUSIONS[check.verdict]}"
