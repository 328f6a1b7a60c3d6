"""Writer of point clouds as PLY, binary little endian, which every point cloud viewer opens."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rosrm_examples.arrays import Points


def write_ply(path: Path, points: Points, colours: NDArray[np.uint8] | None = None) -> None:
    """Write (N, 3) points, metres, with (N, 3) red, green, blue where given."""
    layout: list[tuple[str, str]] = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
    if colours is not None:
        layout += [("red", "u1"), ("green", "u1"), ("blue", "u1")]
    vertices = np.empty(len(points), dtype=layout)
    for axis, name in enumerate(("x", "y", "z")):
        vertices[name] = points[:, axis]
    if colours is not None:
        for channel, name in enumerate(("red", "green", "blue")):
            vertices[name] = colours[:, channel]
    types = {"<f4": "float", "u1": "uchar"}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(points)}",
        *(f"property {types[code]} {name}" for name, code in layout),
        "end_header",
    ]
    with path.open("wb") as file:
        file.write("\n".join(header).encode("ascii") + b"\n")
        file.write(vertices.tobytes())
