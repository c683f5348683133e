"""The sparse map as a PLY file, which every 3D viewer opens."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from improvo.files import written_atomically
from improvo.types import SparseMap

_FIELDS = (
    ("x", "<f4", "float"),
    ("y", "<f4", "float"),
    ("z", "<f4", "float"),
    ("observations", "<i4", "int"),
    ("mean_error", "<f4", "float"),
    ("segment", "<i4", "int"),
)


def write_ply(path: Path, sparse_map: SparseMap) -> None:
    """Binary PLY, one vertex per map point, up to scale."""
    rows = np.zeros(len(sparse_map), np.dtype([(name, kind) for name, kind, _ in _FIELDS]))
    rows["x"], rows["y"], rows["z"] = sparse_map.xyz.T
    rows["observations"], rows["mean_error"] = sparse_map.observations, sparse_map.mean_error
    rows["segment"] = sparse_map.segment
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment improvo map, up to scale",
        f"element vertex {len(rows)}",
    ]
    header += [f"property {kind} {name}" for name, _, kind in _FIELDS]
    with written_atomically(path) as temporary, temporary.open("wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode())
        file.write(rows.tobytes())
