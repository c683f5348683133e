"""What phone recorders have in common: intrinsics for each frame, and poses in OpenGL's camera axes.

The odometry has one K for a whole sequence (paper, "Optimization Variables"). Autofocus moves the focal length of a
phone by a per mille or so, so the median is used; a recording in which it moves by more than 1 % says so in its notes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from improvo.errors import InputError
from improvo.geometry.camera_files import Calibration
from improvo.geometry.text_files import decoded
from improvo.geometry.trajectory_files import clean_poses
from improvo.types import Float64, Trajectory
from improvo.untrusted.paths import check_is_file
from improvo.untrusted.text import load_json, reason

MAX_VARIATION = 0.01
_CV_FROM_GL = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL cameras look along -z with y up


def median_calibration(
    source: str,
    intrinsics: Float64,
    distortion: tuple[float, ...] = (),
    distortion_model: str = "brown",
    size: tuple[int, int] | None = None,
    notes: list[str] | None = None,
) -> Calibration:
    """One calibration from fx, fy, cx, cy (N, 4) of all frames; a line is added to `notes` where they differ by 1 %.

    Raises:
        InputError: no frame has usable intrinsics.
    """
    usable = np.isfinite(intrinsics).all(axis=1) & (intrinsics[:, :2] > 0).all(axis=1)
    if not usable.any():
        raise InputError(f"{source}: no frame has usable intrinsics; give --camera")
    values = intrinsics[usable]
    fx, fy, cx, cy = (float(value) for value in np.median(values, axis=0))
    calibration = Calibration(source, (fx, fy, cx, cy), distortion, distortion_model, size)
    calibration.camera(*(size or (1, 1)))
    variation = float(np.abs(values / [fx, fy, fx, fy] - np.array([fx, fy, cx, cy]) / [fx, fy, fx, fy]).max())
    if variation > MAX_VARIATION and notes is not None:
        notes.append(
            f"{source}: the intrinsics vary by {100 * variation:.1f} % of the focal length between frames; the median "
            "is used, so expect less accuracy (lock the focus when recording)"
        )
    return calibration


def trajectory_from_opengl(
    source: str, times: Float64, world_from_cam_gl: Float64
) -> tuple[Trajectory | None, list[str]]:
    """OpenGL camera poses (N, 4, 4), NaN where unknown, as a trajectory of OpenCV cameras; and notes on bad ones."""
    known = np.asarray(~np.isnan(world_from_cam_gl).all(axis=(1, 2)))
    if not known.any():
        return None, []
    poses, not_finite, not_rigid = clean_poses(world_from_cam_gl @ _CV_FROM_GL)
    bad = [row for row in np.union1d(not_finite, not_rigid).tolist() if known[row]]
    notes = []
    if bad:
        named = ", ".join(map(str, bad[:5])) + (", ..." if len(bad) > 5 else "")
        notes.append(f"{source}: {len(bad)} frames hold no rigid pose ({named})")
    return (Trajectory(times, poses) if np.isfinite(poses).any() else None), notes


def read_json(path: Path, data: bytes | None = None) -> dict[str, Any]:
    """The mapping in a JSON file (or in `data`, read from it).

    Raises:
        InputError: not JSON, or no mapping.
    """
    try:
        content = load_json(decoded(check_is_file(path).read_bytes() if data is None else data))
    except (OSError, ValueError, MemoryError) as error:
        raise InputError(f"{path}: cannot be read as JSON ({reason(error)}); export it again") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: holds no JSON object; export it again")
    return content
