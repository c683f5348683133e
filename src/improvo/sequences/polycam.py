"""Polycam's raw export: `keyframes/images`, `cameras` (one JSON a frame), `depth` in millimetres.

The optimised `corrected_images` and `corrected_cameras` are used where they are. Time stamps are taken as microseconds.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.geometry.trajectory_files import increasing_order
from improvo.sequences.base import SequenceSettings
from improvo.sequences.image_files import ImageFiles, ImageFilesRecording
from improvo.sequences.images import depth_of_size, list_images, read_depth
from improvo.sequences.varying_camera import median_calibration, read_json, trajectory_from_opengl
from improvo.types import Float32
from improvo.untrusted.limits import MAX_PIXELS
from improvo.untrusted.numbers import numbers

DEPTH_SCALE = 1000.0
FPS = 10.0
_POSE = tuple(f"t_{row}{column}" for row in range(3) for column in range(4))


class Polycam(ImageFilesRecording):
    """The export's folder, or its `keyframes`."""

    format = "polycam"

    def __init__(self, path: Path, settings: SequenceSettings) -> None:
        self.path = path
        folder = path / "keyframes" if (path / "keyframes").is_dir() else path
        prefix = (
            "corrected_" if (folder / "corrected_cameras").is_dir() and (folder / "corrected_images").is_dir() else ""
        )
        images = {file.stem: file for file in list_images(folder / f"{prefix}images")}
        names = [name for name in images if (folder / f"{prefix}cameras" / f"{name}.json").is_file()]
        if not names:
            raise InputError(f"{folder}: no image has a camera file beside it; export the raw data again")
        without = len(images) - len(names)
        notes = (
            [f"{folder}: {without} of {len(images)} images have no camera file and were left out"] if without else []
        )
        cameras = [read_json(folder / f"{prefix}cameras" / f"{name}.json") for name in names]
        stamps = np.array([numbers(camera.get("timestamp"), 1)[0] for camera in cameras]) / 1e6
        if settings.fps is None and np.isfinite(stamps).all():
            order, repeated = increasing_order(stamps)
            notes += [f"{folder}: {repeated} images repeat a time stamp and were left out"] if repeated else []
            names, cameras = [names[row] for row in order], [cameras[row] for row in order]
            self.times = stamps[order]
        else:
            self.times = np.arange(len(names)) / (settings.fps or FPS)
        self._images = ImageFiles((images[name] for name in names), path)
        notes += self._images.notes
        self._depth = [folder / "depth" / f"{name}.png" for name in names]
        size_numbers = numbers([cameras[0].get("width"), cameras[0].get("height")], 2)
        possible = (size_numbers >= 1).all() and size_numbers.prod() <= MAX_PIXELS
        size = (int(size_numbers[0]), int(size_numbers[1])) if possible else None
        intrinsics = np.stack([numbers([c.get(key) for key in ("fx", "fy", "cx", "cy")], 4) for c in cameras])
        more: list[str] = []
        name = str(folder / f"{prefix}cameras")
        self.calibration = self.own_calibration(lambda: median_calibration(name, intrinsics, size=size, notes=more))
        self._size = size
        last_row = np.tile([[0.0, 0.0, 0.0, 1.0]], (len(names), 1))
        rows = np.stack([numbers([camera.get(key) for key in _POSE], 12) for camera in cameras])
        poses = np.concatenate([rows, last_row], axis=1).reshape(-1, 4, 4)
        self.ground_truth, problems = trajectory_from_opengl(str(folder), self.times, poses)
        self.notes = (*notes, *more, *problems)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return any(
            (folder / "cameras").is_dir() and (folder / "images").is_dir() for folder in (path / "keyframes", path)
        )

    def depth(self, index: int) -> Float32 | None:
        """The depth image shows the same view at a lower resolution; each pixel looks up the nearest."""
        file = self._depth[index]
        return depth_of_size(read_depth(file, DEPTH_SCALE), self._size) if file.is_file() else None
