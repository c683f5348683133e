"""Trajectory files of the three common layouts: TUM, KITTI and EuRoC."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sivo.errors import InputError
from sivo.geometry.se3 import rigid, rotation_from_quat_xyzw
from sivo.types import Float64, Trajectory

LAYOUTS = ("tum", "kitti", "euroc")
KITTI_FPS = 10.0


def read_trajectory(path: Path, layout: str = "auto", fps: float | None = None) -> Trajectory:
    """Camera-to-world (EuRoC: body-to-world) poses of a file, sorted by time, the first of equal times.

    Layouts, told apart by their columns:
    - tum: `time tx ty tz qx qy qz qw`, seconds;
    - kitti: the 12 numbers of a 3x4 matrix; times from `times.txt` beside it where its length fits, else `fps`,
      else KITTI's 10 Hz;
    - euroc: comma separated `time, p_x, p_y, p_z, q_w, q_x, q_y, q_z[, ...]`, nanoseconds.
    A row with `nan` or `inf`, or with a zero quaternion, is a time without a pose (NaN).

    Raises:
        InputError: no such file, no rows, rows of another shape.
    """
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not text"
        raise InputError(f"{path}: cannot be read ({reason}); give a TUM, KITTI or EuRoC trajectory file") from None
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip() and not line.startswith("#")]
    if not lines:
        raise InputError(f"{path}: holds no poses; give a TUM, KITTI or EuRoC trajectory file")
    commas = "," in lines[0][1]
    rows: list[list[float]] = []
    for number, line in lines:
        try:
            row = [float(word) for word in (line.split(",") if commas else line.split())]
        except ValueError:
            raise InputError(f"{path}: line {number} is not a row of numbers; mend or delete the line") from None
        if rows and len(row) != len(rows[0]):
            raise InputError(
                f"{path}: line {number} has {len(row)} columns, the first row {len(rows[0])}; mend the file"
            )
        rows.append(row)
    values = np.array(rows)
    if layout == "auto":
        layout = _guess(path, values.shape[1], commas)
    if layout == "kitti" and values.shape[1] == 12:
        poses = np.tile(np.eye(4), (len(values), 1, 1))
        poses[:, :3] = values.reshape(-1, 3, 4)
        return Trajectory(_kitti_times(path, len(values), fps), _with_gaps(poses))
    if layout == "tum" and values.shape[1] == 8:
        times, positions, quat_xyzw = values[:, 0], values[:, 1:4], values[:, 4:8]
    elif layout == "euroc" and values.shape[1] >= 8:
        times, positions, quat_xyzw = values[:, 0] * 1e-9, values[:, 1:4], values[:, [5, 6, 7, 4]]
    else:
        raise InputError(f"{path}: {values.shape[1]} columns do not fit layout `{layout}`; known: {', '.join(LAYOUTS)}")
    if not np.isfinite(times).all():
        raise InputError(f"{path}: has a time stamp that is not a number; mend the file")
    times, order = np.unique(times, return_index=True)
    return Trajectory(times, _from_quaternions(positions[order], quat_xyzw[order]))


def share_row_times(estimate: Trajectory, truth: Trajectory) -> Trajectory:
    """A KITTI estimate with the times of its KITTI truth, since both count frames; unchanged if lengths differ."""
    if len(estimate) != len(truth):
        return estimate
    return Trajectory(truth.times, estimate.world_from_cam, estimate.segment)


def _guess(path: Path, columns: int, commas: bool) -> str:
    if columns == 12 and not commas:
        return "kitti"
    if columns == 8 and not commas:
        return "tum"
    if columns >= 8 and commas:
        return "euroc"
    raise InputError(
        f"{path}: {columns} columns fit none of TUM (8), KITTI (12) and EuRoC (8 or more, commas); convert the file"
    )


def _kitti_times(path: Path, count: int, fps: float | None) -> Float64:
    beside = path.with_name("times.txt")
    if fps is None and beside.is_file():
        try:
            times = np.array(beside.read_text().split(), np.float64)
        except ValueError:
            times = np.zeros(0)
        if len(times) == count and (np.diff(times) > 0).all():
            return times
    return np.arange(count) / (fps or KITTI_FPS)


def _from_quaternions(positions: Float64, quat_xyzw: Float64) -> Float64:
    norm = np.linalg.norm(quat_xyzw, axis=1)
    good = np.isfinite(positions).all(axis=1) & np.isfinite(norm) & (norm > 1e-6)
    safe = np.where(good[:, None], quat_xyzw, [0.0, 0.0, 0.0, 1.0])
    poses = rigid(rotation_from_quat_xyzw(safe), positions)
    poses[~good] = np.nan
    return poses


def _with_gaps(poses: Float64) -> Float64:
    poses[~np.isfinite(poses).all(axis=(1, 2))] = np.nan
    return poses
