"""Reference poses from a file: frame numbers with a camera, a TUM trajectory, or the folder of a COLMAP model."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.files import write_text
from improvo.geometry.camera import Camera
from improvo.geometry.camera_files import Calibration
from improvo.geometry.colmap_model import is_colmap_model, read_colmap_model
from improvo.geometry.se3 import inverse, quat_xyzw_from_rotation, rigid, rotation_from_quat_xyzw
from improvo.geometry.text_files import decoded, read_text
from improvo.geometry.trajectory_files import clean_poses, read_trajectory
from improvo.types import Float64, Int64
from improvo.untrusted.paths import check_is_file

UNIT_TOLERANCE = 0.01  # of the norm of a quaternion
_SIZE = re.compile(r"#\s*images\s+(\d+)x(\d+)\s*$")
_FORMATS = "a file of `improvo truth`, a TUM trajectory, or the folder of a COLMAP model"


@dataclass(frozen=True)
class ReferencePoses:
    """Poses to measure against; exactly one of `frames`, `times` and `names` says which images they belong to."""

    source: str  # the file or folder
    world_from_cam: Float64  # (N, 4, 4) metres, or the unit of the model
    frames: Int64 | None = None  # (N,) number in the recording, before any stride
    times: Float64 | None = None  # (N,) seconds, the recording's clock
    names: tuple[str, ...] | None = None  # (N,) image files
    calibration: Calibration | None = None  # of the raw images; None where the file has none


def read_reference(path: Path | str) -> ReferencePoses:
    """Reference poses of a recording.

    Raises:
        InputError: no such file, or none of the formats.
    """
    path = Path(path)
    if path.is_dir():
        if not is_colmap_model(path):
            raise InputError(f"{path}: has no images.txt or images.bin, so it is no COLMAP model; give {_FORMATS}")
        model = read_colmap_model(path)
        world_from_cam = inverse(model.cam_from_world)
        return ReferencePoses(str(path), world_from_cam, names=model.names, calibration=model.calibration)
    lines = read_text(path, "true poses", f"give {_FORMATS}").splitlines()
    numbered = _numbered(lines, path)
    if numbered is not None:
        return numbered
    trajectory = read_trajectory(path, "tum")
    valid = trajectory.valid
    return ReferencePoses(str(path), trajectory.world_from_cam[valid], times=trajectory.times[valid])


def lacks_times(path: Path) -> bool:
    """Whether `path` holds reference poses that belong to frame numbers or image names."""
    if path.is_dir():
        return is_colmap_model(path)
    try:
        return _numbered(decoded(check_is_file(path).read_bytes()).splitlines(), path) is not None
    except (OSError, UnicodeDecodeError):
        return False


def write_reference(
    path: Path, camera: Camera, frames: Int64, world_from_cam: Float64, comments: tuple[str, ...] = ()
) -> None:
    """Write poses by frame number with their camera, as `read_reference` reads them.

    Args:
        path: the file.
        camera: of the raw images, with at most k1, k2, p1, p2.
        frames: (N,) numbers in the recording.
        world_from_cam: (N, 4, 4) metres.
        comments: further lines for a reader.

    Raises:
        InputError: a camera with other distortion, which the file cannot hold.
        OutputError: it cannot be written.
    """
    if not camera.is_pinhole and (camera.distortion_model != "brown" or any(camera.distortion[4:])):
        raise InputError(
            f"{path}: holds k1 k2 p1 p2 of a lens, and the {camera.distortion_model} camera has {camera.distortion}; "
            "undistort the images, or make the COLMAP model with the camera model OPENCV"
        )
    lines = [f"# {comment}" for comment in comments]
    lines += [
        f"# images {camera.width}x{camera.height}",
        "# fx fy cx cy k1 k2 p1 p2, then one line a frame: number tx ty tz qx qy qz qw, camera-to-world, metres",
    ]
    distortion = (*camera.distortion, 0.0, 0.0, 0.0, 0.0)[:4]
    lines.append(" ".join(f"{value:.9g}" for value in (camera.fx, camera.fy, camera.cx, camera.cy, *distortion)))
    for frame, pose in zip(frames.tolist(), world_from_cam, strict=True):
        numbers = (*pose[:3, 3], *quat_xyzw_from_rotation(pose[:3, :3]))
        lines.append(f"{frame} " + " ".join(f"{value:.9g}" for value in numbers))
    write_text(path, "\n".join(lines) + "\n")


def _numbered(lines: list[str], path: Path) -> ReferencePoses | None:
    """Poses by frame number; None for a file whose first row is a pose already, as in a TUM trajectory."""
    size = next(((int(found[1]), int(found[2])) for line in lines if (found := _SIZE.match(line.strip()))), None)
    texts = [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    try:
        rows = [[float(field) for field in text.split()] for text in texts]
    except ValueError:
        return None
    if len(rows) < 2 or any(len(row) != 8 for row in rows) or _is_unit(rows[0][4:]):
        return None
    values = np.array(rows[1:], np.float64)
    camera = rows[0]
    if camera[0] <= 0 or not np.isfinite(values).all():
        raise InputError(
            f"{path}: its first row is neither a pose (quaternion qx qy qz qw of length 1) nor a camera "
            "fx fy cx cy k1 k2 p1 p2, or a number is not finite; repair the file"
        )
    frames = values[:, 0].astype(np.int64)
    if (frames != values[:, 0]).any() or (frames < 0).any() or len(np.unique(frames)) < len(frames):
        raise InputError(f"{path}: the first column must hold different frame numbers from 0 on; repair the file")
    bad = [int(frame) for frame, row in zip(frames, values, strict=True) if not _is_unit(row[4:].tolist())]
    if bad:
        raise InputError(f"{path}: frame {bad[0]} has no unit quaternion qx qy qz qw; repair the file")
    poses = clean_poses(rigid(rotation_from_quat_xyzw(values[:, 4:]), values[:, 1:4]))[0]
    order = np.argsort(frames)
    fx, fy, cx, cy = camera[:4]
    calibration = Calibration(str(path), (fx, fy, cx, cy), tuple(camera[4:]) if any(camera[4:]) else (), size=size)
    return ReferencePoses(str(path), poses[order], frames=frames[order], calibration=calibration)


def _is_unit(quaternion: list[float]) -> bool:
    return abs(float(np.linalg.norm(quaternion)) - 1.0) <= UNIT_TOLERANCE
