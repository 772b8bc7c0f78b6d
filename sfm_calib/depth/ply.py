"""PLY files: points or a mesh, with normals, colours and one number a vertex; are they whole?"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from graphs.frames import FloatArray
from graphs.problem import IntArray

TYPES = {"<f8": "double", "<f4": "float", "u1": "uchar"}
SIZES = {
    "char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2,
    "int": 4, "uint": 4, "int32": 4, "uint32": 4, "float": 4, "float32": 4, "double": 8,
    "float64": 8,
}  # fmt: skip
LEAST_IN_LIST = {
    "vertex_indices": 3,
    "vertex_index": 3,
}  # a face's corners; other lists may be empty


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


def is_whole(data: bytes) -> bool:
    """Whether a PLY is as long as its header says, at least; True of any other file.

    Open3D reads what there is of a truncated one, and leaves the rest of the points at zero.
    """
    head, ended, body = data.partition(b"end_header")
    if not data.startswith(b"ply"):
        return True
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    rows, length, count = 0, 0, 0
    try:
        for words in filter(None, lines):
            if words[0] == "element":
                count = int(words[2])
                rows += count
            elif words[:2] == ["property", "list"]:
                least = LEAST_IN_LIST.get(words[4], 0)
                length += count * (SIZES[words[2]] + least * SIZES[words[3]])
            elif words[0] == "property":
                length += count * SIZES[words[1]]
    except (IndexError, KeyError, ValueError):
        return False
    if ["format", "ascii", "1.0"] in lines:
        return bool(ended) and sum(1 for line in body.splitlines() if line.strip()) >= rows
    return bool(ended) and len(body.removeprefix(b"\r").removeprefix(b"\n")) >= length
