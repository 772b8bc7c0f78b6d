"""The description of a calibration target: its pattern, its size, and how well that is known.

Every type counts something else, and its YAML key says what: the inner corners of a checkerboard,
the squares of a ChArUco board, the tags of an AprilGrid, the circles of a grid of circles.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Annotated, ClassVar, Literal

import cv2
import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationInfo,
    field_validator,
)

from graphs.frames import FloatArray
from graphs.problem import IntArray

BoardType = Literal["checkerboard", "charuco", "aprilgrid", "circles"]
# Of a length on the board: office printers are off by 0.1 to 0.5 %, good boards by less.
DEFAULT_RELATIVE_SIGMA = 0.001
# Of a square: corners of two real boards predict views held out best when they are believed to be
# where they belong to within 1 to 3 thousandths of it.
DEFAULT_MISPRINT = 0.002
MOST = 100  # of anything along one side of a board
TAG36H11_IDS = 587  # tags in the family
DICTIONARIES = tuple(sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_")))

LONGEST_M = 2.0  # of a square or a tag: what is longer was given in mm or in squares


def _in_metres(length_m: float) -> float:
    if not length_m > 0:
        raise ValueError(f"{length_m:g} m is no length; give metres, as 0.025")
    if length_m > LONGEST_M:
        raise ValueError(
            f"{length_m:g} m is longer than any square; give metres: {length_m / 1000:g} for "
            f"{length_m:g} mm"
        )
    return length_m


Length = Annotated[float, AfterValidator(_in_metres)]
Count = Annotated[int, Field(ge=2, le=MOST)]


class Board(BaseModel):
    """A flat target. Its frame: origin in corner 0, x along a row to the right, y down, z into it.

    One of its four types below; what they share is here.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    length_name: ClassVar[str]  # the field with the length that scales the whole board

    type: BoardType
    square_sigma_m: Length | None = None  # of that length, as an error of the whole board's scale
    warp: bool = True  # whether the board may be bent a little
    # How far single corners may lie from where they belong, in every direction; 0: not at all.
    corner_sigma_m: float | None = Field(default=None, ge=0, le=1)

    @property
    def unit_m(self) -> float:
        """The length that scales the board: of a square, a tag, or between circles."""
        return float(getattr(self, self.length_name))

    @property
    def relative_sigma(self) -> float:
        """Of every length on the board, relative."""
        if self.square_sigma_m is None:
            return DEFAULT_RELATIVE_SIGMA
        return self.square_sigma_m / self.unit_m

    @property
    def misprint_m(self) -> float:
        """Sigma of where single corners lie."""
        if self.corner_sigma_m is None:
            return DEFAULT_MISPRINT * self.unit_m
        return self.corner_sigma_m

    @property
    @abstractmethod
    def corners_m(self) -> FloatArray:
        """Corners (n, 3) in the board's frame, in the order of their numbers; z = 0."""

    @property
    def symmetries(self) -> tuple[IntArray, ...]:
        """Renumberings (n,) of the corners under which the pattern looks the same, the identity
        left out: corner i may as well be corner renumbering[i]."""
        return ()

    @property
    @abstractmethod
    def columns(self) -> int:
        """Corners in a row."""

    @property
    @abstractmethod
    def rows(self) -> int:
        """Corners in a column."""

    @property
    @abstractmethod
    def described(self) -> str:
        """The board in a few words, as messages call it."""


class Checkerboard(Board):
    """A checkerboard, known by its inner corners, where four squares meet.

    Where the numbers of columns and rows tell a side by its colour, the square before corner 0 is
    black.
    """

    length_name = "square_m"

    type: Literal["checkerboard"] = "checkerboard"
    inner_corners: tuple[Count, Count]  # in a row, in a column
    square_m: Length

    @property
    def columns(self) -> int:
        return self.inner_corners[0]

    @property
    def rows(self) -> int:
        return self.inner_corners[1]

    @property
    def corners_m(self) -> FloatArray:
        return _grid(self.columns, self.rows) * self.square_m

    @property
    def symmetries(self) -> tuple[IntArray, ...]:
        numbers = np.arange(self.columns * self.rows).reshape(self.rows, self.columns)
        if (self.columns + self.rows) % 2:
            return ()  # a half turn swaps black and white
        half = np.rot90(numbers, 2).ravel()
        if self.columns != self.rows or self.columns % 2:
            return (half,)  # so does a quarter turn of a square board of odd counts
        return (np.rot90(numbers, 1).ravel(), half, np.rot90(numbers, 3).ravel())

    @property
    def described(self) -> str:
        return f"a checkerboard of {self.columns} x {self.rows} inner corners"


class Charuco(Board):
    """A checkerboard with an ArUco marker in every white square, as OpenCV lays it out.

    Its corners are the inner corners of the checkerboard, numbered as OpenCV does.
    """

    length_name = "square_m"

    type: Literal["charuco"] = "charuco"
    squares: tuple[Count, Count]  # in a row, in a column
    square_m: Length
    marker_m: Length
    dictionary: str = Field(default="DICT_4X4_50", validate_default=True)
    legacy: bool = False  # the layout of OpenCV before 4.6, which differs for even rows
    inverted: bool = False  # printed with black and white swapped
    two_sided: bool = False  # on its back the same pattern shows through, mirrored

    @field_validator("dictionary")
    @classmethod
    def _dictionary_has_enough(cls, name: str, info: ValidationInfo) -> str:
        if name not in DICTIONARIES:
            raise ValueError(f"OpenCV has no such dictionary; it has {_closest(name)}")
        columns, rows = info.data.get("squares", (0, 0))
        there = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)).bytesList)
        if columns * rows // 2 > there:
            raise ValueError(
                f"{columns} x {rows} squares need {columns * rows // 2} markers, and it has "
                f"{there}: take one of 250 or 1000"
            )
        return name

    @field_validator("marker_m")
    @classmethod
    def _marker_fits_its_square(cls, marker_m: float, info: ValidationInfo) -> float:
        square_m = info.data.get("square_m", np.inf)
        if marker_m >= square_m:
            raise ValueError(f"a marker must be smaller than a square of {square_m:g} m")
        return marker_m

    @field_validator("squares")
    @classmethod
    def _has_inner_corners(cls, squares: tuple[int, int]) -> tuple[int, int]:
        if (squares[0] - 1) * (squares[1] - 1) < 4:
            raise ValueError("3 squares or more are needed on both sides to have 4 inner corners")
        return squares

    @property
    def columns(self) -> int:
        return self.squares[0] - 1

    @property
    def rows(self) -> int:
        return self.squares[1] - 1

    @property
    def corners_m(self) -> FloatArray:
        return _grid(self.columns, self.rows) * self.square_m

    @property
    def described(self) -> str:
        return (
            f"a ChArUco board of {self.squares[0]} x {self.squares[1]} squares "
            f"({self.dictionary}{', legacy' * self.legacy}{', inverted' * self.inverted})"
        )


class Aprilgrid(Board):
    """Kalibr's grid of tag36h11 tags with black squares between their corners.

    Tags are numbered from the bottom left, row by row upwards. The corners are numbered as Kalibr
    does: from the bottom left corner of tag 0, along whole rows of corners, upwards; so their y is
    0 and negative here, where y points down.
    """

    length_name = "tag_m"

    type: Literal["aprilgrid"] = "aprilgrid"
    tags: tuple[Annotated[int, Field(ge=1, le=MOST)], Annotated[int, Field(ge=1, le=MOST)]]
    tag_m: Length  # side of the black square
    spacing: Annotated[float, Field(gt=0, lt=1)]  # gap between two tags, in sides of a tag
    border_bits: Annotated[int, Field(ge=1, le=4)] = 2  # width of a tag's black frame
    first_id: Annotated[int, Field(ge=0)] = 0  # of the tag at the bottom left
    inverted: bool = False  # printed with black and white swapped
    two_sided: bool = False  # on its back the same pattern shows through, mirrored

    @field_validator("tags")
    @classmethod
    def _tags_exist(cls, tags: tuple[int, int]) -> tuple[int, int]:
        n_tags = tags[0] * tags[1]
        if not 2 <= n_tags <= TAG36H11_IDS:
            raise ValueError(f"{n_tags} tags: 2 to {TAG36H11_IDS} are possible with tag36h11")
        return tags

    @field_validator("first_id")
    @classmethod
    def _ids_exist(cls, first_id: int, info: ValidationInfo) -> int:
        tags = info.data.get("tags", (1, 1))
        last = first_id + tags[0] * tags[1] - 1
        if last >= TAG36H11_IDS:
            raise ValueError(f"the last tag would be {last}; tag36h11 ends at {TAG36H11_IDS - 1}")
        return first_id

    @property
    def columns(self) -> int:
        return 2 * self.tags[0]

    @property
    def rows(self) -> int:
        return 2 * self.tags[1]

    @property
    def corners_m(self) -> FloatArray:
        place = _grid(self.columns, self.rows)
        tag, side = np.divmod(place, 2)
        up = tag * (1 + self.spacing) + side
        result: FloatArray = up * self.tag_m * np.array([1.0, -1.0, 0.0])
        return result + 0.0  # no -0

    @property
    def described(self) -> str:
        return f"an AprilGrid of {self.tags[0]} x {self.tags[1]} tags"


class Circles(Board):
    """A grid of circles as OpenCV lays it out; its corners are the centres of the circles.

    In an asymmetric one every other row is shifted to the right by half the distance of circles in
    a row.
    """

    length_name = "spacing_m"

    type: Literal["circles"] = "circles"
    circles: tuple[Count, Count]  # in a row, rows
    spacing_m: Length  # between rows; in an asymmetric grid circles in a row are twice as far apart
    diameter_m: Length | None = None  # of a circle; needed only to print it
    asymmetric: bool = True
    inverted: bool = False  # white circles on black

    @field_validator("diameter_m")
    @classmethod
    def _circles_do_not_touch(cls, diameter_m: float | None, info: ValidationInfo) -> float | None:
        spacing_m = info.data.get("spacing_m", np.inf)
        # Circles of an asymmetric grid, whose flag comes later, have their neighbours farther off.
        if diameter_m is not None and diameter_m >= np.sqrt(2) * spacing_m:
            raise ValueError(f"circles would touch at a spacing of {spacing_m:g} m")
        return diameter_m

    @property
    def columns(self) -> int:
        return self.circles[0]

    @property
    def rows(self) -> int:
        return self.circles[1]

    @property
    def nearest_m(self) -> float:
        """Distance of neighbouring circles."""
        return float(self.spacing_m * (np.sqrt(2) if self.asymmetric else 1))

    @property
    def corners_m(self) -> FloatArray:
        grid = _grid(self.columns, self.rows)
        if self.asymmetric:
            grid[:, 0] = 2 * grid[:, 0] + grid[:, 1] % 2
        return grid * self.spacing_m

    @property
    def symmetries(self) -> tuple[IntArray, ...]:
        numbers = np.arange(self.columns * self.rows).reshape(self.rows, self.columns)
        half = np.rot90(numbers, 2).ravel()
        if self.asymmetric:
            # With an odd number of rows the first and the last are shifted alike, and a half turn
            # shows it.
            return () if self.rows % 2 else (half,)
        if self.columns != self.rows:
            return (half,)
        return (np.rot90(numbers, 1).ravel(), half, np.rot90(numbers, 3).ravel())

    @property
    def described(self) -> str:
        kind = "asymmetric" if self.asymmetric else "symmetric"
        return f"an {kind} grid of {self.columns} x {self.rows} circles".replace("an s", "a s")


BOARD_TYPES: dict[str, type[Board]] = {
    "checkerboard": Checkerboard,
    "charuco": Charuco,
    "aprilgrid": Aprilgrid,
    "circles": Circles,
}


def _grid(columns: int, rows: int) -> FloatArray:
    """Column, row, 0 of every place (n, 3), row by row."""
    x, y = np.meshgrid(np.arange(columns, dtype=float), np.arange(rows, dtype=float))
    result: FloatArray = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    return result


def _closest(name: str) -> str:
    parts = name.upper().removeprefix("DICT_").split("_")
    like = [each for each in DICTIONARIES if parts[0] in each] or list(DICTIONARIES)
    return ", ".join(like)
