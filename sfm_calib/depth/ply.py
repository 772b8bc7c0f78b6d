"""PLY files: points or a mesh, with normals, colours and one number a vertex."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphs.frames import FloatArray
from graphs.problem import IntArray

TYPES = {"<f8": "double", "<f4": "float", "u1": "uchar"}


def ply(
    points: FloatArray,
    normals: FloatArray | None = None,
    colours: NDArray[np.uint8] | None = None,
    quality: FloatArray | None = None,
    triangles: IntArray | None = None,
    comment: str = "",
) -> bytes:
    """A binary PLY of points (n, 3) with normals, colours (n, 3), a number (n,); triangles (m, 3).

    The number is called `quality`, as MeshLab and CloudCompare know it.
    """
    columns: list[tuple[str, str, NDArray[Any]]] = [
        (axis, "<f8", points[:, i]) for i, axis in enumerate("xyz")
    ]
    if normals is not None:
        columns += [(f"n{axis}", "<f4", normals[:, i]) for i, axis in enumerate("xyz")]
    if colours is not None:
        columns += [(name, "u1", colours[:, i]) for i, name in enumerate(("red", "green", "blue"))]
    if quality is not None:
        columns.append(("quality", "<f4", quality))
    rows = np.empty(len(points), dtype=[(name, kind) for name, kind, _ in columns])
    for name, _, values in columns:
        rows[name] = values
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"comment {comment.encode('ascii', 'replace').decode()}"] if comment else []
    header += [f"element vertex {len(points)}"]
    header += [f"property {TYPES[kind]} {name}" for name, kind, _ in columns]
    body = rows.tobytes()
    if triangles is not None and len(triangles):
        header += [f"element face {len(triangles)}", "property list uchar int vertex_indices"]
        faces = np.empty(len(triangles), dtype=[("n", "u1"), ("vertices", "<i4", 3)])
        faces["n"], faces["vertices"] = 3, triangles
        body += faces.tobytes()
    return "\n".join([*header, "end_header", ""]).encode() + body
