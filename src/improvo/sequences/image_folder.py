"""A folder of images, in the order of their numbers.

Beside the images, or one folder up from an `images` folder, there may be `camera.yaml` (calibration, fps),
`times.txt` (seconds, one per image) and `groundtruth.txt` (any trajectory file, camera-to-world).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.geometry.camera_files import folder_calibration
from improvo.geometry.trajectory_files import increasing_order, read_times, read_trajectory_report
from improvo.sequences.base import Recording, SequenceSettings
from improvo.sequences.images import list_images, read_image
from improvo.sequences.rates import frame_rate
from improvo.types import Float64, UInt8

_SUBFOLDERS = ("images", "image", "rgb", "color", "frames", "imgs")


class ImageFolder(Recording):
    """Images in the folder itself or in its `images` (`rgb`, `color`, ...) folder."""

    format = "images"

    def __init__(self, path: Path, settings: SequenceSettings) -> None:
        self.path = path
        folder = _image_folder(path)
        if folder is None:
            raise InputError(f"{path}: has no images (png, jpg, tif, ...), nor an images folder with some")
        self._files = list_images(folder)
        extras = path if folder != path or not _is_images_of(path) else path.parent
        self.calibration = self.own_calibration(lambda: folder_calibration(path), lambda: folder_calibration(extras))
        notes: list[str] = []
        times_file = next((f / "times.txt" for f in (path, extras) if (f / "times.txt").is_file()), None)
        if times_file is not None and settings.fps is None:
            times = read_times(times_file)
            if len(times) != len(self._files):
                raise InputError(
                    f"{times_file}: has {len(times)} times for {len(self._files)} images; repair it, or give --fps"
                )
            order, repeated = increasing_order(times)
            if repeated:
                notes.append(f"{times_file}: {repeated} images repeat a time stamp and were left out")
            if repeated or (order != np.arange(len(order))).any():
                self._files = [self._files[row] for row in order]
            self.times = times[order]
        else:
            rate, note = frame_rate(self.calibration, settings)
            notes += [f"{path}: {note}"] if note else []
            self.times = _frame_numbers(self._files) / rate
        truth = next((f / "groundtruth.txt" for f in (path, extras) if (f / "groundtruth.txt").is_file()), None)
        if truth is not None:
            self.ground_truth, problems = read_trajectory_report(truth)
            notes += problems
        self.notes = tuple(notes)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return _image_folder(path) is not None

    def source(self, index: int) -> str:
        return str(self._files[index])

    def image(self, index: int) -> UInt8:
        return read_image(self._files[index])


def _image_folder(path: Path) -> Path | None:
    if not path.is_dir():
        return None
    for folder in (path, *(path / name for name in _SUBFOLDERS)):
        if folder.is_dir() and list_images(folder):
            return folder
    return None


def _is_images_of(path: Path) -> bool:
    """Whether this is the `images` folder of a recording that was named by its inside."""
    return path.name in _SUBFOLDERS


def _frame_numbers(files: list[Path]) -> Float64:
    """Frame numbers from 0: those in the file names where a mostly unbroken count shows which frames are missing."""
    ordinal = np.arange(len(files), dtype=np.float64)
    matches = [re.fullmatch(r"(.*?)(\d{1,15})", file.stem) for file in files]
    numbered = [match for match in matches if match is not None]
    if len(numbered) < len(files) or len({match.group(1) for match in numbered}) != 1:
        return ordinal
    numbers = np.array([int(match.group(2)) for match in numbered], np.float64)
    steps = np.diff(numbers)
    if len(steps) == 0 or (steps < 1).any() or np.median(steps) != 1 or steps.max() > 1000:
        return ordinal
    return numbers - numbers[0]
