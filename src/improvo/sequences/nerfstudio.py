"""Nerfstudio's and instant-ngp's `transforms.json`: images with intrinsics and OpenGL camera poses.

Frames are in the order of their file names' numbers. Principal points are measured from the corner of the top-left
pixel, as in COLMAP; they are moved by half a pixel. Depth images are 16 bit, in units of `depth_unit_scale_factor`
metres (default 0.001).
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from improvo.errors import InputError
from improvo.geometry.camera_files import Calibration, camera_of
from improvo.sequences.base import SequenceSettings, UnreadableFrameError
from improvo.sequences.image_files import ImageFiles, ImageFilesRecording
from improvo.sequences.images import depth_of_size, listed_file, natural_key, read_depth
from improvo.sequences.rates import frame_rate
from improvo.sequences.varying_camera import median_calibration, read_json, trajectory_from_opengl
from improvo.types import Float32, Float64
from improvo.untrusted.limits import MAX_PIXELS
from improvo.untrusted.numbers import numbers

_NAMES = ("transforms.json", "transforms_train.json")
_NO_LENS = {
    *("frames", "w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov"),
    *("aabb_scale", "scale", "offset", "aabb", "render_aabb", "sharpness", "colmap_im_id", "applied_scale"),
    *("applied_transform", "orientation_override", "train_filenames", "val_filenames", "test_filenames", "up"),
    *("depth_unit_scale_factor", "timestamp", "time", "integer_depth_scale", "enable_depth_loading", "rotation"),
}


class Nerfstudio(ImageFilesRecording):
    """A folder with `transforms.json`, or that file."""

    format = "nerfstudio"

    def __init__(self, path: Path, settings: SequenceSettings) -> None:
        self.path = path
        inside = (path / name for name in _NAMES if (path / name).is_file())
        file = next(inside, path / _NAMES[0]) if path.is_dir() else path
        content = read_json(file)
        frames = content.get("frames")
        frames = [f for f in frames if isinstance(f, dict) and f.get("file_path")] if isinstance(frames, list) else []
        if not frames:
            raise InputError(f"{file}: lists no frames with a file_path; export it again")
        frames.sort(key=lambda frame: natural_key(str(frame["file_path"])))
        self._images = ImageFiles((_file(file.parent, str(frame["file_path"])) for frame in frames), path)
        self._depth = [frame.get("depth_file_path") for frame in frames]
        self._folder = file.parent
        unit = numbers(content.get("depth_unit_scale_factor", 0.001), 1)[0]
        self._scale = 1 / unit if unit > 0 else 1000.0
        notes = list(self._images.notes)
        self._size = _size(content, frames) or _size_of_picture(self._images)
        if self._size is not None:
            content = {**content, "w": self._size[0], "h": self._size[1]}
        self.calibration = self.own_calibration(lambda: _calibration(str(file), content, frames, notes))
        rate, note = frame_rate(None, settings, path)
        notes += [f"{path}: {note}"] if note else []
        self.times = np.arange(len(frames)) / rate
        poses = np.stack([numbers(frame.get("transform_matrix"), 16).reshape(4, 4) for frame in frames])
        self.ground_truth, problems = trajectory_from_opengl(str(file), self.times, poses)
        self.notes = (*notes, *problems)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return path.name in _NAMES or any((path / name).is_file() for name in _NAMES)

    def depth(self, index: int) -> Float32 | None:
        name = self._depth[index]
        if not name:
            return None
        return depth_of_size(read_depth(listed_file(self._folder, str(name)), self._scale), self._size)


def _file(folder: Path, name: str) -> Path:
    """The image; names without an ending mean PNG, as in NeRF's synthetic scenes."""
    return listed_file(folder, name if Path(name.replace("\\", "/")).suffix else f"{name}.png")


def _calibration(
    source: str, content: dict[str, Any], frames: list[dict[str, Any]], notes: list[str]
) -> Calibration | None:
    """Intrinsics of all frames, those of the whole file where a frame has none; None where neither has any.

    A line is added to `notes` where they vary.

    Raises:
        InputError: a lens that is not supported, or one that changes between frames.
    """
    size = _size(content, frames)
    rows = np.stack([_intrinsics(frame, content, size) for frame in frames])
    if not np.isfinite(rows).all(axis=1).any():
        return None
    lenses = [{key: value for key, value in frame.items() if _is_lens(key)} for frame in frames]
    if any(lens != lenses[0] for lens in lenses):
        raise InputError(f"{source}: the distortion changes between frames; undistort the images, or give --camera")
    usable = rows[np.isfinite(rows).all(axis=1)][0] + [0.0, 0.0, 0.5, 0.5]
    given = {key: value for key, value in content.items() if _is_lens(key) or key in ("w", "h")} | lenses[0]
    lens = camera_of({**given, **dict(zip(("fl_x", "fl_y", "cx", "cy"), usable.tolist(), strict=True))}, source)
    return median_calibration(source, rows, lens.distortion, lens.distortion_model, size, notes)


def _size(content: dict[str, Any], frames: list[dict[str, Any]]) -> tuple[int, int] | None:
    """Width and height of the images, None where the file does not say, or says what no picture can have."""
    values = numbers([_value(frames[0], content, "w"), _value(frames[0], content, "h")], 2)
    possible = np.isfinite(values).all() and (values >= 1).all() and values.prod() <= MAX_PIXELS
    return (int(values[0]), int(values[1])) if possible else None


def _size_of_picture(images: ImageFiles) -> tuple[int, int] | None:
    """Width and height of the first picture, where the file does not say them (NeRF's synthetic scenes)."""
    try:
        height, width = images.read(0).shape[:2]
    except UnreadableFrameError:
        return None
    return width, height


def _is_lens(key: str) -> bool:
    """Whether a key of the file or of a frame is about the lens; names, poses and sizes are not."""
    return key not in _NO_LENS and not key.endswith(("_path", "_matrix"))


def _intrinsics(frame: dict[str, Any], content: dict[str, Any], size: tuple[int, int] | None) -> Float64:
    """fx, fy, cx, cy of one frame, the centre of the top-left pixel at (0, 0)."""
    values = [_value(frame, content, name) for name in ("fl_x", "fl_y", "cx", "cy")]
    angle = numbers(_value(frame, content, "camera_angle_x"), 1)[0]
    if values[0] is None and size is not None and 0 < angle < math.pi:
        values[0] = 0.5 * size[0] / math.tan(angle / 2)
    if values[1] is None:
        values[1] = values[0]
    if size is not None:
        values[2] = size[0] / 2 if values[2] is None else values[2]
        values[3] = size[1] / 2 if values[3] is None else values[3]
    return numbers(values, 4) - [0.0, 0.0, 0.5, 0.5]


def _value(frame: dict[str, Any], content: dict[str, Any], name: str) -> Any:
    return frame.get(name, content.get(name))
