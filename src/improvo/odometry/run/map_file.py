"""The sparse map as a PLY file, which every 3D viewer opens: written and read."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.files import written_atomically
from improvo.types import SparseMap
from improvo.untrusted.paths import check_is_file
from improvo.untrusted.text import reason

_FIELDS = (
    ("x", "<f4", "float"),
    ("y", "<f4", "float"),
    ("z", "<f4", "float"),
    ("observations", "<i4", "int"),
    ("mean_error", "<f4", "float"),
    ("segment", "<i4", "int"),
    ("id", "<i4", "int"),
)

_COLOURS = tuple((name, "u1", "uchar") for name in ("red", "green", "blue"))
_PLY_TYPES = {"float": "<f4", "double": "<f8", "int": "<i4", "uint": "<u4", "uchar": "u1", "short": "<i2"}


def write_map(path: Path, sparse_map: SparseMap, unit: str = "up to scale") -> None:
    """Binary PLY, one vertex per map point; `unit` of lengths goes into a comment."""
    fields = _FIELDS if sparse_map.rgb is None else (*_FIELDS, *_COLOURS)
    rows = np.zeros(len(sparse_map), np.dtype([(name, kind) for name, kind, _ in fields]))
    rows["x"], rows["y"], rows["z"] = sparse_map.xyz.T
    rows["observations"], rows["mean_error"] = sparse_map.observations, sparse_map.mean_error
    rows["segment"], rows["id"] = sparse_map.segment, sparse_map.ids
    if sparse_map.rgb is not None:
        rows["red"], rows["green"], rows["blue"] = sparse_map.rgb.T
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment improvo map, {unit.encode('ascii', 'replace').decode()}",
        f"element vertex {len(rows)}",
    ]
    header += [f"property {kind} {name}" for name, _, kind in fields]
    with written_atomically(path) as temporary, temporary.open("wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode())
        file.write(rows.tobytes())


def read_map(path: Path) -> SparseMap:
    """Read the `map.ply` of a run; the ids are -1 in a file from before maps had them.

    Raises:
        InputError: missing, damaged, or not written by improvo.
    """
    try:
        content = check_is_file(path).read_bytes()
    except (OSError, MemoryError) as error:
        raise InputError(f"{path}: cannot be read ({reason(error)}); `improvo run` writes it") from None
    header, separator, body = content.partition(b"end_header\n")
    lines = header.decode("ascii", "replace").split("\n")
    counts = [line.split()[2] for line in lines if re.fullmatch(r"element vertex \d{1,12}\s*", line)]
    count = int(counts[0]) if counts else -1
    properties = [line.split() for line in lines if line.startswith("property")]
    if not separator or count < 0 or "format binary_little_endian 1.0" not in lines:
        raise InputError(f"{path}: is no map that improvo wrote; run `improvo run` again")
    try:
        if count == 0:
            body = b""
        dtype = np.dtype([(name, _PLY_TYPES[kind]) for _, kind, name in properties])
        vertices = np.frombuffer(body, dtype, count)
        xyz = np.stack([vertices[axis] for axis in "xyz"], axis=1).astype(np.float64)
        mean_error = vertices["mean_error"].astype(np.float64)
        coloured = all(name in (dtype.names or ()) for name, _, _ in _COLOURS)
        rgb = np.stack([vertices[name] for name, _, _ in _COLOURS], axis=1).astype(np.uint8) if coloured else None
        return SparseMap(
            ids=vertices["id"].astype(np.int64) if "id" in (dtype.names or ()) else np.full(count, -1),
            xyz=xyz,
            observations=vertices["observations"].astype(np.int64),
            mean_error=mean_error,
            max_error=np.full(count, np.nan),
            segment=vertices["segment"].astype(np.int64),
            rgb=rgb,
        )
    except (ValueError, KeyError) as error:
        raise InputError(
            f"{path}: is damaged or no map that improvo wrote ({error}); run `improvo run` again"
        ) from None
