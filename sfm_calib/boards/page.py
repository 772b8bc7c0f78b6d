"""Boards to print: a page of PDF true to scale, with rulers to check it by, and the board's YAML.

Shapes are vectors in mm; PDF has its origin at the bottom left (ISO 32000-1).
"""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from pydantic import BaseModel, ConfigDict

from sfm_calib.boards.load import board_from, board_yaml, load_board
from sfm_calib.boards.pattern import Pattern, pattern_of
from sfm_calib.boards.spec import Board, BoardType
from sfm_calib.errors import CalibrationError
from sfm_calib.files import write_atomically

PageName = Literal["a4", "a3", "a2", "a1", "a0", "letter", "tabloid"]
PAGES_MM: dict[str, tuple[float, float]] = {
    "a4": (210.0, 297.0),
    "a3": (297.0, 420.0),
    "a2": (420.0, 594.0),
    "a1": (594.0, 841.0),
    "a0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
    "tabloid": (279.4, 431.8),
}
POINTS_PER_MM = 72 / 25.4
EDGE_MM = 6.0  # that printers leave white; and at least so much around the pattern
RULER_MM, LINE_MM = 10.0, 2.8  # heights of the rulers with their numbers, and of a line of text
TEXT_MM, CHARACTER_MM = 2.1, 1.15  # size of the text, and the width of its characters at most
HAIR_MM = 0.1
SHORTEST_MM = 60.0  # width of a page: rulers and text need it
CIRCLE = 0.5522847498  # length of the handles of four curves that make a circle of radius 1
NOTE = (
    "Print at 100 %, not fitted to the page, and check the rulers. Then measure the board itself."
)


class BoardPrint(BaseModel):
    """What to print: a board of a type, or that of a file, and on which page."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    board: Annotated[Path | None, tyro.conf.arg(metavar="YAML")] = None
    """File with the board, instead of the flags that describe one."""
    type: BoardType | None = None
    """Type of the board."""
    inner_corners: tuple[int, int] | None = None
    """Of a checkerboard: corners where four squares meet, in a row and in a column."""
    squares: tuple[int, int] | None = None
    """Of a ChArUco board: squares in a row and in a column."""
    tags: tuple[int, int] | None = None
    """Of an AprilGrid: tags in a row and in a column."""
    circles: tuple[int, int] | None = None
    """Of a grid of circles: circles in a row, and rows."""
    square_m: float | None = None
    """Side of a square, in metres."""
    marker_m: float | None = None
    """Side of a marker of a ChArUco board, in metres."""
    dictionary: str | None = None
    """OpenCV's name of the dictionary of a ChArUco board's markers."""
    tag_m: float | None = None
    """Side of a tag of an AprilGrid, in metres."""
    spacing: float | None = None
    """Gap between the tags of an AprilGrid, in sides of a tag."""
    spacing_m: float | None = None
    """Distance between rows of circles, in metres."""
    diameter_m: float | None = None
    """Of circles, in metres."""
    page: PageName | Literal["auto"] = "auto"
    """Size of the page; auto: as large as the board needs."""

    def described_board(self) -> Board:
        """The board that is described, or read. Raises CalibrationError."""
        given: dict[str, Any] = self.model_dump(exclude={"board", "page"}, exclude_none=True)
        if self.board is not None:
            if given:
                raise CalibrationError(
                    f"{next(iter(given))} is given beside a board from {self.board}: give one or "
                    "the other"
                )
            return load_board(self.board)
        return board_from(given)


def write_board(options: BoardPrint, path: Path) -> tuple[Path, Path]:
    """Write a board's page, and its YAML beside it; returns both paths.

    Raises CalibrationError when the board does not fit the page or a file cannot be written.
    """
    if path.suffix.lower() != ".pdf":
        raise CalibrationError(f"{path}: the page is written as PDF; call it {path.stem}.pdf")
    board = options.described_board()
    page = board_page(board, options.page)
    description = path.with_suffix(".yaml")
    write_atomically(path, page)
    write_atomically(description, board_yaml(board))
    return path, description


def board_page(board: Board, page: PageName | Literal["auto"] = "auto") -> bytes:
    """A PDF of one page with the board true to scale, rulers in mm and inches, and its YAML.

    Raises CalibrationError, with the size that would fit, when the page is too small.
    """
    pattern = pattern_of(board)
    left, top, right, bottom = pattern.box
    inner = 1000 * (right - left), 1000 * (bottom - top)
    width, height = _page_size(board, inner, page)
    text = _text(board, width)
    below = _band(len(text))
    # The board lies in the middle of what the rulers and the text leave.
    x, y = (width - inner[0]) / 2, below + (height - below - inner[1] - EDGE_MM) / 2
    lines = [f"{POINTS_PER_MM:.9f} 0 0 {POINTS_PER_MM:.9f} 0 0 cm"]
    lines += _shapes(pattern, x, y + inner[1])
    lines += _rulers(width, EDGE_MM + len(text) * LINE_MM)
    for number, line in enumerate(reversed(text)):
        lines.append(_words(EDGE_MM, EDGE_MM + number * LINE_MM, line))
    return _pdf("\n".join(lines), width, height)


def _text(board: Board, width: float) -> list[str]:
    """The lines of text below the rulers of a page so wide."""
    described = "   ".join(board_yaml(board).splitlines())
    characters = int((width - 2 * EDGE_MM) / CHARACTER_MM)
    return [*textwrap.wrap(NOTE, characters), *textwrap.wrap(described, characters)]


def _band(lines: int) -> float:
    """Height of what lies below the board's white margin, with the lower edge of the page."""
    return EDGE_MM + lines * LINE_MM + RULER_MM + EDGE_MM


def _page_size(
    board: Board, inner: tuple[float, float], page: PageName | Literal["auto"]
) -> tuple[float, float]:
    """Width and height of the page in mm, upright or lying as the board fits."""
    if page == "auto":
        width = max(inner[0] + 2 * EDGE_MM, SHORTEST_MM)
        return width, inner[1] + EDGE_MM + _band(len(_text(board, width)))
    short, long = PAGES_MM[page]
    fits = {}
    for width, height in ((short, long), (long, short)):
        room = width - 2 * EDGE_MM, height - EDGE_MM - _band(len(_text(board, width)))
        fits[width, height] = min(room[0] / inner[0], room[1] / inner[1])
    best = max(fits, key=lambda size: fits[size])
    if fits[best] >= 1:
        return best
    largest_m = np.floor(board.unit_m * fits[best] * 1e4) / 1e4
    raise CalibrationError(
        f"{board.described} is {inner[0]:.0f} x {inner[1]:.0f} mm and does not fit {page} "
        f"({short:g} x {long:g} mm) with its margin and rulers: take a larger page, or a "
        f"{board.length_name} of {largest_m:g} at most"
    )


def _shapes(pattern: Pattern, x: float, y: float) -> list[str]:
    """The board with the top left corner of its box at x, y."""
    left, top = pattern.box[0] * 1000, pattern.box[1] * 1000
    lines = ["0 g"]
    if pattern.inverted:
        margin = min(1000 * pattern.margin_m, EDGE_MM)
        width = 1000 * (pattern.box[2] - pattern.box[0]) + 2 * margin
        height = 1000 * (pattern.box[3] - pattern.box[1]) + 2 * margin
        lines += [_rectangle(x - margin, y + margin - height, width, height), "f", "1 g"]
    for x0, y0, x1, y1 in pattern.rectangles * 1000:
        lines.append(_rectangle(x + x0 - left, y - (y1 - top), x1 - x0, y1 - y0))
    for centre_x, centre_y, diameter in pattern.discs * 1000:
        lines.append(_disc(x + centre_x - left, y - (centre_y - top), diameter / 2))
    # One path: where rectangles touch, filling them one by one may leave a hairline.
    return [*lines, "f", "0 g"]


def _rectangle(x: float, y: float, width: float, height: float) -> str:
    return f"{x:.5f} {y:.5f} {width:.5f} {height:.5f} re"


def _disc(x: float, y: float, radius: float) -> str:
    around = np.array([[1, 0], [1, CIRCLE], [CIRCLE, 1], [0, 1]])
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    lines = [f"{x + radius:.5f} {y:.5f} m"]
    for _ in range(4):
        points = (np.array([x, y]) + radius * around[1:]).ravel()
        lines.append(" ".join(f"{value:.5f}" for value in points) + " c")
        around = around @ quarter.T
    return "\n".join(lines)


def _rulers(width: float, y: float) -> list[str]:
    """A line with mm above and inches below it, both from the left edge of the text."""
    line = y + RULER_MM / 2
    length = width - 2 * EDGE_MM
    lines = [f"{HAIR_MM} w"]
    for count in range(int(length) + 1):
        tall = 3.0 if count % 10 == 0 else 2.2 if count % 5 == 0 else 1.4
        lines.append(_stroke(EDGE_MM + count, line, line + tall))
        if count % 10 == 0 and count + 10 < length:
            unit = " mm" if count == 0 else ""
            lines.append(_words(EDGE_MM + count + 0.4, line + 2.6, f"{count}{unit}"))
    for count in range(int(length / 25.4 * 8) + 1):
        tall = 3.0 if count % 8 == 0 else 2.2 if count % 4 == 0 else 1.4
        x = EDGE_MM + count * 25.4 / 8
        lines.append(_stroke(x, line, line - tall))
        if count % 8 == 0 and x + 10 < EDGE_MM + length:
            unit = " inch" if count == 0 else ""
            lines.append(_words(x + 0.4, line - 4.2, f"{count // 8}{unit}"))
    end = EDGE_MM + int(length)
    return [*lines, f"{EDGE_MM:.5f} {line:.5f} m {end:.5f} {line:.5f} l S"]


def _stroke(x: float, y: float, end: float) -> str:
    return f"{x:.5f} {y:.5f} m {x:.5f} {end:.5f} l S"


def _words(x: float, y: float, text: str) -> str:
    escaped = text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
    return f"BT /F {TEXT_MM} Tf {x:.3f} {y:.3f} Td ({escaped}) Tj ET"


def _pdf(content: str, width: float, height: float) -> bytes:
    """A PDF of one page in mm with this content."""
    stream = content.encode("latin-1")
    box = f"[0 0 {width * POINTS_PER_MM:.4f} {height * POINTS_PER_MM:.4f}]"
    font = "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>"
    objects = [
        # Viewers that know PrintScaling offer 100 % first.
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /Contents 4 0 R "
        f"/Resources << /Font << /F {font} >> >> >>".encode(),
        b"<< /Length %d >>\nstream\n" % len(stream) + stream + b"\nendstream",
    ]
    data, places = b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n", []
    for number, each in enumerate(objects, start=1):
        places.append(len(data))
        data += b"%d 0 obj\n" % number + each + b"\nendobj\n"
    table = b"".join(b"%010d 00000 n \n" % place for place in places)
    head = b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    tail = b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n"
    return data + head + table + tail % (len(objects) + 1, len(data))
