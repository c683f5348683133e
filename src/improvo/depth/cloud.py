"""The fused point cloud: one point for each small cell that several frames agree on."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from improvo.depth.depth_map import DepthMap
from improvo.depth.settings import CloudSettings
from improvo.files import written_atomically
from improvo.types import Float64, Int64, UInt8

_BITS = 21  # of each cell coordinate
_MERGE_EVERY = 16  # maps


class DenseCloud:
    """Collects the agreed pixels of depth maps; the points of a cell become their mean, with the mean colour.

    Args:
        settings: the size of a cell and the rules.
        unit: what the first median depth of the run is in the unit of the poses: 1, or metres per unit of the odometry.
    """

    def __init__(self, settings: CloudSettings, unit: float = 1.0) -> None:
        self._settings, self._cell = settings, settings.voxel * unit
        self._keys: Int64 = np.zeros(0, np.int64)
        self._sums: Float64 = np.zeros((0, 7))  # x, y, z, red, green, blue, count
        self._pending: list[tuple[Int64, Float64]] = []

    def add(self, depth_map: DepthMap, picture: UInt8, world_from_cam: Float64) -> None:
        """Add the pixels of a map on which enough frames agree.

        Args:
            depth_map: with `agreeing`.
            picture: (h, w, 3) BGR, or (h, w) grey, of the size of the map.
            world_from_cam: (4, 4).
        """
        chosen = depth_map.depth > 0
        if depth_map.agreeing is not None:
            chosen &= depth_map.agreeing >= self._settings.least
        rows, columns = np.nonzero(chosen)
        if len(rows) == 0:
            return
        rays = np.linalg.inv(depth_map.K) @ np.stack([columns, rows, np.ones(len(rows))])
        points = (rays * depth_map.depth[rows, columns]).T @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
        colours = picture[rows, columns].astype(np.float64)
        colours = np.repeat(colours[:, None], 3, axis=1) if colours.ndim == 1 else colours[:, ::-1]
        cells = np.floor(points / self._cell).astype(np.int64) + (1 << (_BITS - 1))
        inside = ((cells >= 0) & (cells < 1 << _BITS)).all(axis=1)
        keys = (cells[:, 0] << 2 * _BITS) | (cells[:, 1] << _BITS) | cells[:, 2]
        sums = np.concatenate([points, colours, np.ones((len(points), 1))], axis=1)
        self._pending.append(_merged(keys[inside], sums[inside]))
        if len(self._pending) >= _MERGE_EVERY:
            self._merge()

    def _merge(self) -> None:
        keys = np.concatenate([self._keys, *(keys for keys, _ in self._pending)])
        sums = np.concatenate([self._sums, *(sums for _, sums in self._pending)])
        self._keys, self._sums = _merged(keys, sums)
        self._pending = []

    def points(self) -> tuple[Float64, UInt8]:
        """Positions (P, 3) in the world and colours (P, 3), red first."""
        self._merge()
        count = self._sums[:, 6]
        full = count >= self._settings.least_points
        means = self._sums[full, :6] / count[full, None]
        return means[:, :3], np.rint(means[:, 3:]).astype(np.uint8)


def _merged(keys: Int64, sums: Float64) -> tuple[Int64, Float64]:
    """Rows of equal keys summed, sorted by key."""
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    starts = np.flatnonzero(np.diff(keys, prepend=-1))
    return keys[starts], np.add.reduceat(sums[order], starts) if len(starts) else sums[:0]


def write_cloud(path: Path, points: Float64, colours: UInt8, unit: str = "up to scale") -> None:
    """A binary PLY of points (P, 3) in a unit and colours (P, 3), red first, which every 3D viewer opens."""
    kinds = [(axis, "<f4") for axis in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.zeros(len(points), np.dtype(kinds))
    for column, (name, _) in enumerate(kinds):
        rows[name] = points[:, column] if column < 3 else colours[:, column - 3]
    words = {"<f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"comment improvo dense points, {unit}"]
    header += [f"element vertex {len(rows)}", *(f"property {words[kind]} {name}" for name, kind in kinds)]
    with written_atomically(path) as temporary, temporary.open("wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii", "replace"))
        file.write(rows.tobytes())
