"""A furnished room: triangle meshes with relief, light baked in, and a texture for each surface.

The world has z up; the floor's centre is the origin; lengths are metres. The middle of the
room stays free for the trajectories of `rigs.py`, but for one pedestal at the origin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from graphs.frames import FloatArray, Transform, exp_rotation
from sfm_calib.open3d_import import import_open3d
from sfm_calib.simulate.textures import (
    Float32,
    Grey,
    TextureSet,
    TextureStyle,
    pack,
    pink_noise,
    texture,
)

BoardName = Literal["none", "checkerboard", "charuco"]

ROOM_SIZE_M = (6.0, 5.0, 2.8)
TEXELS_PER_M = 400.0  # a camera of 540 px focal length resolves 400 per metre from 1.35 m
CELL_M, RELIEF_CELL_M = 0.1, 0.05
LIGHTS: tuple[tuple[tuple[float, float, float], float], ...] = (  # position, strength
    ((-1.2, 0.8, 2.5), 1.9),
    ((1.6, -0.9, 2.4), 1.5),
)
AMBIENT = 0.6
BOARD_PLACE = Transform(  # upright before the wall at y = 2.5, facing the room
    np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]), np.array([-0.27, 2.2, 1.75])
)


@dataclass(frozen=True)
class HungBoard:
    """A calibration board in the room, with the truth about it.

    The board's frame has its origin at the pattern's top left corner, x right and y down as one
    looks at it, as OpenCV's CharucoBoard has.
    """

    kind: BoardName
    columns: int = 9  # squares
    rows: int = 7
    square_m: float = 0.06
    marker_m: float = 0.042  # seven cells of 6 mm: whole texels
    dictionary: str = "DICT_5X5_100"
    margin_m: float = 0.03
    world_from_board: Transform = BOARD_PLACE

    @property
    def corners_m(self) -> FloatArray:
        """Inner corners in the board's frame ((rows - 1) * (columns - 1), 3), row after row."""
        x, y = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        return self.square_m * np.stack([x, y, 0.0 * x], -1).reshape(-1, 3)


@dataclass(frozen=True)
class Sheet:
    """One surface: a grid of points, its texture stretched evenly over the grid."""

    points: FloatArray  # (rows, columns, 3), columns to the right as one looks at it
    size_m: tuple[float, float]  # width, height of the texture
    style: TextureStyle


@dataclass(frozen=True)
class Mesh:
    """All triangles, in the order in which the ray caster numbers them."""

    corner: Float32  # (n, 3) first vertex
    edges: Float32  # (n, 2, 3) second and third vertex minus the first
    uv: Float32  # (n, 3, 2) texel coordinates at the vertices, texel centres at integers
    light: Float32  # (n, 3) irradiance at the vertices
    surface: NDArray[np.int32]  # (n,)


@dataclass(frozen=True)
class Room:
    """What a camera can look at."""

    mesh: Mesh
    textures: TextureSet
    board: HungBoard | None
    scene: Any  # open3d.t.geometry.RaycastingScene; open3d has no types

    def distance_m(self, points: FloatArray) -> FloatArray:
        """Distance (n,) of points (n, 3) to the nearest surface."""
        query = np.ascontiguousarray(points, dtype=np.float32)
        return self.scene.compute_distance(query).numpy().astype(np.float64)


def build_room(
    rng: np.random.Generator, board: BoardName = "none", texels_per_m: float = TEXELS_PER_M
) -> Room:
    """A room with its own relief, furniture and textures.

    Raises CalibrationError when open3d, which casts the rays, is missing.
    """
    open3d = import_open3d()
    sheets = _walls(rng) + _furniture(rng)
    pictures = [texture(s.style, s.size_m, texels_per_m, rng) for s in sheets]
    hung = None if board == "none" else HungBoard(board)
    if hung:
        sheets.append(_board_sheet(hung))
        pictures.append(_board_picture(hung))
    mesh, vertices, triangles = _triangulate(sheets, pictures)
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(vertices, triangles)
    return Room(mesh, pack(pictures), hung, scene)


def _sheet(
    origin: Sequence[float],
    right: Sequence[float],
    down: Sequence[float],
    style: TextureStyle,
    relief: FloatArray | None = None,
) -> Sheet:
    """A rectangle from its top left corner; relief (rows, columns) rises towards the viewer."""
    u, v = np.asarray(right, float), np.asarray(down, float)
    width, height = float(np.linalg.norm(u)), float(np.linalg.norm(v))
    rows, columns = relief.shape if relief is not None else _cells((width, height), CELL_M)
    a, b = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
    points = np.asarray(origin, float) + a[..., None] * u + b[..., None] * v
    if relief is not None:
        points += relief[..., None] * np.cross(v, u) / (width * height)
    return Sheet(points, (width, height), style)


def _cells(size_m: tuple[float, float], cell_m: float) -> tuple[int, int]:
    """Grid points (rows, columns) over a width and a height."""
    return max(2, round(size_m[1] / cell_m) + 1), max(2, round(size_m[0] / cell_m) + 1)


def _walls(rng: np.random.Generator) -> list[Sheet]:
    x, y, z = ROOM_SIZE_M[0] / 2, ROOM_SIZE_M[1] / 2, ROOM_SIZE_M[2]
    plans: list[tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...], TextureStyle]] = [
        ((-x, y, z), (2 * x, 0, 0), (0, 0, -z), "collage"),
        ((x, -y, z), (-2 * x, 0, 0), (0, 0, -z), "stone"),
        ((x, y, z), (0, -2 * y, 0), (0, 0, -z), "plaster"),
        ((-x, -y, z), (0, 2 * y, 0), (0, 0, -z), "plaster"),
        ((-x, y, 0), (2 * x, 0, 0), (0, -2 * y, 0), "wood"),
        ((-x, -y, z), (2 * x, 0, 0), (0, 2 * y, 0), "plaster"),
    ]
    heights_m = (0.16, 0.14, 0.18, 0.16, 0.03, 0.10)
    return [
        _sheet(*plan, _relief((np.linalg.norm(plan[1]), np.linalg.norm(plan[2])), height, rng))
        for plan, height in zip(plans, heights_m, strict=True)
    ]


def _relief(size_m: tuple[Any, Any], height_m: float, rng: np.random.Generator) -> FloatArray:
    """Heights (rows, columns) from 0 to height_m: bumps and raised panels, level at the border."""
    rows, columns = _cells(size_m, RELIEF_CELL_M)
    bumps = cv2.GaussianBlur(pink_noise((rows, columns), 1 / RELIEF_CELL_M, rng), (0, 0), 2.0)
    panels = np.zeros((rows, columns), np.float32)
    for _ in range(10):
        r, c = rng.integers(0, rows), rng.integers(0, columns)
        h, w = rng.integers(4, 16, 2)
        panels[r : r + h, c : c + w] = rng.uniform(0.3, 1.0)
    heights = 0.5 + 0.25 * bumps / bumps.std() + 0.5 * panels
    taper = np.minimum.outer(
        np.minimum(np.arange(rows), np.arange(rows)[::-1]),
        np.minimum(np.arange(columns), np.arange(columns)[::-1]),
    )
    return height_m * np.clip(heights, 0, 1.3) / 1.3 * np.clip(taper / 3.0, 0, 1)


def _furniture(rng: np.random.Generator) -> list[Sheet]:
    """Objects along the walls and under the ceiling, and the pedestal in the middle."""
    boxes: list[tuple[tuple[float, ...], tuple[float, ...], float, TextureStyle]] = [
        ((-1.6, 2.24, 0.5), (1.2, 0.45, 1.0), 0.0, "wood"),  # centre, size, tilt_deg, style
        ((-1.5, 2.35, 1.65), (0.9, 0.28, 0.22), 0.0, "collage"),
        ((1.75, 2.26, 0.3), (0.6, 0.4, 0.6), 0.0, "plaster"),
        ((1.75, 2.3, 0.78), (0.35, 0.3, 0.3), 12.0, "collage"),
        ((1.2, -2.26, 0.75), (0.8, 0.42, 1.5), 0.0, "wood"),
        ((-0.4, -2.36, 1.5), (1.0, 0.26, 0.2), 0.0, "stone"),
        ((-1.9, -2.26, 0.35), (0.7, 0.4, 0.7), 8.0, "collage"),
        ((2.68, 0.9, 0.35), (0.55, 0.7, 0.7), 0.0, "collage"),
        ((2.72, 0.85, 0.9), (0.4, 0.4, 0.4), 0.0, "plaster"),
        ((2.8, -0.1, 1.8), (0.3, 0.6, 0.3), 10.0, "wood"),
        ((-2.68, 0.5, 0.76), (0.6, 1.4, 0.08), 0.0, "wood"),
        ((-2.7, 0.2, 0.3), (0.45, 0.5, 0.6), 0.0, "collage"),
        ((-2.72, -1.3, 0.6), (0.5, 0.6, 1.2), 0.0, "stone"),
        ((-0.7, 0.9, 2.69), (0.7, 0.3, 0.14), 0.0, "collage"),
        ((1.0, -0.8, 2.70), (0.4, 0.8, 0.12), 0.0, "stone"),
        ((0.0, 0.0, 0.31), (0.26, 0.26, 0.62), 0.0, "collage"),
    ]
    sheets: list[Sheet] = []
    for centre, size_m, tilt_deg, style in boxes:
        sheets += _box(np.array(centre), np.array(size_m), tilt_deg, style, rng)
    for x, y, radius_m in ((0.75, 2.24, 0.15), (-1.1, -2.27, 0.14), (2.72, -1.4, 0.17)):
        sheets.append(_cylinder((x, y), radius_m, ROOM_SIZE_M[2], "plaster"))
    for centre, radius_m in (((-2.65, 0.8, 0.98), 0.18), ((0.0, 0.0, 0.8), 0.18)):
        sheets.append(_sphere(np.array(centre), radius_m, "stone"))
    return sheets


def _box(
    centre: FloatArray,
    size_m: FloatArray,
    tilt_deg: float,
    style: TextureStyle,
    rng: np.random.Generator,
) -> list[Sheet]:
    turn = exp_rotation(np.array([0, 0, np.deg2rad(rng.uniform(-5, 5))]))
    turn = turn @ exp_rotation(np.array([np.deg2rad(tilt_deg), 0, 0]))
    faces = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal = np.eye(3)[axis] * sign
            down = np.array([0, 0, -1.0]) if axis < 2 else np.array([0, -1.0, 0])
            right = np.cross(normal, down)
            right, down = right * size_m, down * size_m
            corner = (normal * size_m - right - down) / 2
            faces.append(_sheet(centre + turn @ corner, turn @ right, turn @ down, style))
    return faces


def _cylinder(
    foot: tuple[float, float], radius_m: float, height_m: float, style: TextureStyle
) -> Sheet:
    angle, z = np.meshgrid(np.linspace(0, 2 * np.pi, 49), np.linspace(height_m, 0, 29))
    x, y = foot[0] + radius_m * np.cos(angle), foot[1] + radius_m * np.sin(angle)
    return Sheet(np.stack([x, y, z], -1), (2 * np.pi * radius_m, height_m), style)


def _sphere(centre: FloatArray, radius_m: float, style: TextureStyle) -> Sheet:
    angle, polar = np.meshgrid(np.linspace(0, 2 * np.pi, 65), np.linspace(0, np.pi, 33))
    unit = np.stack(
        [np.cos(angle) * np.sin(polar), np.sin(angle) * np.sin(polar), np.cos(polar)], -1
    )
    return Sheet(centre + radius_m * unit, (2 * np.pi * radius_m, np.pi * radius_m), style)


def _board_sheet(board: HungBoard) -> Sheet:
    margin = board.margin_m
    width, height = board.columns * board.square_m, board.rows * board.square_m
    rotation = board.world_from_board.rotation
    origin = board.world_from_board @ np.array([-margin, -margin, 0.0])
    right, down = rotation[:, 0] * (width + 2 * margin), rotation[:, 1] * (height + 2 * margin)
    return _sheet(origin.tolist(), right.tolist(), down.tolist(), "plaster")


def _board_picture(board: HungBoard) -> Grey:
    """The printed board at 1000 texels per metre, so that its squares are whole texels."""
    square, margin = round(board.square_m * 1000), round(board.margin_m * 1000)
    if board.kind == "charuco":
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        shape = (board.columns, board.rows)
        pattern = cv2.aruco.CharucoBoard(shape, board.square_m, board.marker_m, dictionary)
        picture = pattern.generateImage((board.columns * square, board.rows * square))
    else:
        rows, columns = np.indices((board.rows * square, board.columns * square)) // square
        picture = ((rows + columns) % 2 * 255).astype(np.uint8)
    picture = cv2.copyMakeBorder(
        picture, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=255
    )
    return (25 + picture.astype(np.float32) * (205 / 255)).astype(np.uint8)  # paper, not a lamp


def _triangulate(
    sheets: list[Sheet], pictures: list[Grey]
) -> tuple[Mesh, Float32, NDArray[np.uint32]]:
    """The mesh, and its vertices (n, 3) and triangles (n, 3) for the ray caster."""
    vertices, uv, light, triangles, surface = [], [], [], [], []
    first = 0
    for index, (sheet, picture) in enumerate(zip(sheets, pictures, strict=True)):
        rows, columns = sheet.points.shape[:2]
        vertices.append(sheet.points.reshape(-1, 3))
        light.append(_irradiance(sheet.points).ravel())
        x = np.linspace(0, picture.shape[1], columns) - 0.5
        y = np.linspace(0, picture.shape[0], rows) - 0.5
        uv.append(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))
        numbers = first + np.arange(rows * columns).reshape(rows, columns)
        a, b, c, d = numbers[:-1, :-1], numbers[:-1, 1:], numbers[1:, :-1], numbers[1:, 1:]
        halves = np.concatenate([np.stack([a, b, c], -1), np.stack([b, d, c], -1)])
        triangles.append(halves.reshape(-1, 3))
        surface.append(np.full(len(triangles[-1]), index, np.int32))
        first += rows * columns
    points = np.concatenate(vertices).astype(np.float32)
    corners = np.concatenate(triangles)
    p = points[corners]
    mesh = Mesh(
        corner=np.ascontiguousarray(p[:, 0]),
        edges=np.ascontiguousarray(p[:, 1:] - p[:, :1]),
        uv=np.concatenate(uv).astype(np.float32)[corners],
        light=np.concatenate(light).astype(np.float32)[corners],
        surface=np.concatenate(surface),
    )
    return mesh, points, corners.astype(np.uint32)


def _irradiance(points: FloatArray) -> FloatArray:
    """Lambert's law at the vertices (rows, columns): the same from every viewpoint."""
    normals = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    total = np.full(points.shape[:2], AMBIENT)
    for position, strength in LIGHTS:
        to_light = np.asarray(position) - points
        distance = np.linalg.norm(to_light, axis=-1)
        cosine = np.maximum(0, (normals * to_light).sum(-1) / np.maximum(distance, 1e-6))
        total += strength * cosine / (1 + distance**2)
    return np.minimum(total, 1.25)
