"""Surfaces: meshes, or clouds of points that stand for one, and the nearest point on them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from graphs.frames import FloatArray, Transform
from graphs.problem import IntArray
from sfm_calib.depth.ply import is_whole
from sfm_calib.errors import CalibrationError
from sfm_calib.open3d_import import import_open3d

NORMAL_NEIGHBOURS = 30  # of a point of a cloud, that its plane is laid through
PURPOSE = "surfaces"
FORMATS = "PLY, OBJ, STL, OFF, glTF, and clouds as PLY, PCD, XYZ, PTS"


@dataclass(frozen=True)
class Surface:
    """Triangles, or without any the points themselves."""

    vertices: FloatArray  # (n, 3) in m
    triangles: IntArray  # (m, 3)

    @property
    def is_mesh(self) -> bool:
        return bool(len(self.triangles))

    @cached_property
    def is_closed(self) -> bool:
        """Whether it has an inside, which signs of distances need: each edge has two triangles.

        Open3D's own test also looks at every pair of triangles: minutes, of some 100,000.
        """
        edges = np.sort(self.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        return self.is_mesh and bool((np.unique(edges, axis=0, return_counts=True)[1] == 2).all())

    @cached_property
    def _middle(self) -> FloatArray:
        """Open3D casts in single precision: coordinates are taken from the middle."""
        middle: FloatArray = (self.vertices.min(axis=0) + self.vertices.max(axis=0)) / 2
        return middle

    @cached_property
    def _scene(self) -> Any:
        open3d = import_open3d(PURPOSE)
        scene = open3d.t.geometry.RaycastingScene()
        vertices = (self.vertices - self._middle).astype(np.float32)
        scene.add_triangles(
            open3d.core.Tensor(vertices), open3d.core.Tensor(self.triangles.astype(np.uint32))
        )
        return scene

    @cached_property
    def _tree(self) -> KDTree:
        return KDTree(self.vertices)

    @cached_property
    def _normals(self) -> FloatArray:
        """Unit normals (n, 3) of a cloud's points, either way."""
        open3d = import_open3d(PURPOSE)
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(self.vertices))
        cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(NORMAL_NEIGHBOURS))
        return np.asarray(cloud.normals)

    def closest(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The nearest point on it (n, 3) of each of (n, 3), and the unit normal (n, 3) there.

        Of a mesh right to 1e-7 of its size, of a cloud one of its points.
        """
        if not self.is_mesh:
            _, near = self._tree.query(points)
            return self.vertices[near], self._normals[near]
        open3d = import_open3d(PURPOSE)
        asked = open3d.core.Tensor((points - self._middle).astype(np.float32))
        found = self._scene.compute_closest_points(asked)
        nearest = found["points"].numpy().astype(np.float64) + self._middle
        corners = self.vertices[self.triangles[found["primitive_ids"].numpy().astype(np.int64)]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        return nearest, normal / np.where(length > 0, length, 1.0)

    def inside(self, points: FloatArray) -> NDArray[np.bool_]:
        """Which of (n, 3) are within a closed mesh (n,)."""
        open3d = import_open3d(PURPOSE)
        asked = open3d.core.Tensor((points - self._middle).astype(np.float32))
        within: NDArray[np.bool_] = self._scene.compute_occupancy(asked).numpy() > 0.5
        return within

    def sampled(self, count: int, seed: int) -> FloatArray:
        """Points (k, 3) on it: of a mesh `count`, evenly by area; of a cloud its own."""
        if not self.is_mesh:
            return self.vertices
        rng = np.random.default_rng(seed)
        a, b, c = (self.vertices[self.triangles[:, corner]] for corner in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        which = rng.choice(len(area), count, p=area / area.sum())
        u, v = rng.random((2, count, 1))
        fold = u + v > 1
        u, v = np.where(fold, 1 - u, u), np.where(fold, 1 - v, v)
        inner: FloatArray = a[which] + u * (b - a)[which] + v * (c - a)[which]
        return inner

    def moved(self, transform: Transform) -> Surface:
        """The same elsewhere."""
        return Surface(transform @ self.vertices, self.triangles)


def load_surface(path: Path, metres: float = 1.0) -> Surface:
    """A mesh, or where the file has no triangles its points; a unit of it is so many metres.

    Raises CalibrationError where the file holds neither, or numbers that are no places.
    """
    open3d = import_open3d(PURPOSE)
    if not path.is_file():
        raise CalibrationError(f"{path} is not there: give a file of a mesh or a cloud ({FORMATS})")
    if path.suffix.lower() == ".ply" and not is_whole(path.read_bytes()):
        raise CalibrationError(
            f"{path} is shorter than its header says: it is truncated; copy it anew"
        )
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        mesh = open3d.io.read_triangle_mesh(str(path))
        # STL, and seams of textures, repeat vertices: no edge would be shared.
        mesh = mesh.remove_duplicated_vertices()
        vertices, triangles = np.asarray(mesh.vertices), np.asarray(mesh.triangles)
        if not len(triangles):
            vertices = np.asarray(open3d.io.read_point_cloud(str(path)).points)
    if not len(vertices):
        raise CalibrationError(f"{path} holds no mesh and no points that can be read ({FORMATS})")
    wrong = ~np.isfinite(vertices).all(axis=1)
    if wrong.any():
        raise CalibrationError(
            f"{path}: {wrong.sum()} of {len(vertices)} points are no numbers, the first number "
            f"{int(np.flatnonzero(wrong)[0])}: clean it first"
        )
    corners = vertices[triangles.reshape(-1, 3)]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).reshape(-1, 3),
        axis=1,
    )
    if len(triangles) and not area.any():
        raise CalibrationError(f"{path}: its {len(triangles)} triangles have no area")
    triangles = triangles.astype(np.int64).reshape(-1, 3)
    apart = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)  # else it is a line
    return Surface(metres * vertices.astype(np.float64), triangles[apart])


def painted(surface: Surface, colours: FloatArray) -> bytes:
    """The surface as a PLY with a colour (n, 3), 0 to 1, for each vertex."""
    vertex = np.zeros(
        len(surface.vertices),
        dtype=[*((axis, "<f8") for axis in "xyz"), *((c, "u1") for c in ("red", "green", "blue"))],
    )
    for axis, column in zip("xyz", surface.vertices.T, strict=True):
        vertex[axis] = column
    for name, column in zip(("red", "green", "blue"), colours.T, strict=True):
        vertex[name] = np.round(255 * np.clip(column, 0, 1)).astype(np.uint8)
    face = np.zeros(len(surface.triangles), dtype=[("n", "u1"), ("corner", "<i4", 3)])
    face["n"], face["corner"] = 3, surface.triangles
    header = [
        "ply", "format binary_little_endian 1.0", f"element vertex {len(vertex)}",
        *(f"property double {axis}" for axis in "xyz"),
        *(f"property uchar {colour}" for colour in ("red", "green", "blue")),
    ]  # fmt: skip
    if surface.is_mesh:
        header += [f"element face {len(face)}", "property list uchar int vertex_indices"]
    text = "\n".join([*header, "end_header", ""])
    return text.encode() + vertex.tobytes() + (face.tobytes() if surface.is_mesh else b"")
