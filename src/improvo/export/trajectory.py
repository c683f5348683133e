"""Trajectories in the formats of other tools: TUM, KITTI, EuRoC's CSV."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.files import write_text
from improvo.geometry.se3 import quat_xyzw_from_rotation
from improvo.sequences import write_trajectory
from improvo.types import Trajectory

FORMATS = ("tum", "kitti", "euroc")
_EUROC_HEADER = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],"
    "v_RS_R_x [m s^-1],v_RS_R_y [m s^-1],v_RS_R_z [m s^-1],b_w_RS_S_x [rad s^-1],b_w_RS_S_y [rad s^-1],"
    "b_w_RS_S_z [rad s^-1],b_a_RS_S_x [m s^-2],b_a_RS_S_y [m s^-2],b_a_RS_S_z [m s^-2]\n"
)


def export_trajectory(trajectory: Trajectory, frames: int, path: Path, format: str, unit: str = "up to scale") -> None:
    """Write camera-to-world poses. Lengths are those of the run, which may be up to scale though a header says metres.

    Args:
        trajectory: the frames with a pose.
        frames: of the processed sequence; KITTI's format has no times and so cannot leave frames out.
        path: the file.
        format: one of FORMATS.
        unit: of lengths, for the first line of a TUM file.

    Raises:
        InputError: KITTI's format, and some frames have no pose.
    """
    if format == "kitti" and len(trajectory) < frames:
        missing = frames - len(trajectory)
        raise InputError(f"{path}: KITTI's format cannot leave out frames and {missing} have no pose; use tum or euroc")
    if format == "euroc":
        write_text(path, _euroc_text(trajectory))
    else:
        write_trajectory(path, trajectory, format, unit)


def _euroc_text(trajectory: Trajectory) -> str:
    """EuRoC's state file; a camera has no velocity or biases, which are zero."""
    lines = [_EUROC_HEADER]
    for row in np.flatnonzero(trajectory.valid):
        pose = trajectory.world_from_cam[row]
        x, y, z, w = (float(value) for value in quat_xyzw_from_rotation(pose[:3, :3]))
        numbers = ",".join(f"{value:.12g}" for value in (*pose[:3, 3].tolist(), w, x, y, z))
        lines.append(f"{round(trajectory.times[row] * 1e9)},{numbers}{',0' * 9}\n")
    return "".join(lines)
