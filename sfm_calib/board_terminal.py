"""What a person sees in the terminal of the board that took part."""

from __future__ import annotations

import math

from rich.table import Table

from sfm_calib.report.digits import short
from sfm_calib.result import BoardResult, Calibration, Sigmas

SEEN = {
    "": "in images of its own",
    "still": "standing in the scan",
    "waved": "moved about in the scan",
}
NOTICED = 2.0  # sigmas from which a bend or a size is worth a word


def board_lines(board: BoardResult) -> list[str]:
    """Where the board was seen, and what it turned out to be like."""
    seen = ", ".join(
        f"{name} {board.n_images[name]} images with {board.n_corners[name]} corners"
        + (f" ({short(board.sigma_px[name])} px)" if name in board.sigma_px else "")
        for name in board.n_images
    )
    lines = [f"board: {board.description}, {SEEN[board.in_scan]}: {seen}"]
    said = []
    if abs(board.size - 1) > NOTICED * board.sigma_size > 0:
        said.append(
            f"{100 * (board.size - 1):+.2f} +- {100 * board.sigma_size:.2f} % larger than stated"
        )
    for which, bend, sigma in zip(
        ("left and right", "top and foot"), board.bend_mm, board.sigma_bend_mm, strict=True
    ):
        if sigma > 0 and abs(bend) > NOTICED * sigma:
            said.append(f"bent by {bend:.2g} +- {sigma:.1g} mm between {which}")
    if said:
        lines.append(f"the board is {' and '.join(said)}")
    elif max(board.sigma_bend_mm) > 0:
        lines.append(
            f"the board is flat to {short(max(board.sigma_bend_mm))} mm and as large as stated"
        )
    return lines


def with_and_without(calibration: Calibration) -> Table | None:
    """Each parameter's sigma from the scan alone, and with the board; None without either."""
    board = calibration.board
    if board is None or not board.without:
        return None
    table = Table()
    for column in ("", "sigma of the scan", "with the board", "gain", "moved"):
        table.add_column(column, justify="right" if column else "left", no_wrap=True)
    table.columns[0].no_wrap, table.columns[0].overflow = False, "fold"
    stated = {name: sigmas.stated for name, sigmas in _sigmas(calibration).items()}
    for name, alone in board.without.items():
        sigma = stated.get(name)
        if sigma is None:
            continue
        # radians are told in degrees, as everywhere
        unit = math.degrees(1) if ".rotation_" in name else 1.0
        table.add_row(
            name + (" (deg)" if unit != 1 else ""),
            "no metre" if alone.sigma is None else short(alone.sigma * unit),
            short(sigma * unit),
            "" if not alone.sigma else f"{alone.sigma / sigma:.1f} x",
            "" if alone.moved is None else f"{short(alone.moved * unit)}",
        )
    return table


def _sigmas(calibration: Calibration) -> dict[str, Sigmas]:
    return calibration.noise.sigmas if calibration.noise else {}
