"""A folder of images, in the order of their numbers.

Beside the images, or one folder up from an `images` folder, there may be `camera.yaml` (calibration, fps),
`times.txt` (one time per image) and `groundtruth.txt` (any trajectory file, camera-to-world). Without `times.txt`, file
names that are time stamps give the times.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.geometry.camera_files import folder_calibration
from improvo.geometry.time_units import in_seconds, unit_of
from improvo.geometry.trajectory_files import has_times, increasing_order, read_times, read_trajectory_report
from improvo.sequences.base import SequenceSettings
from improvo.sequences.image_files import ImageFiles, ImageFilesRecording
from improvo.sequences.image_kinds import one_kind
from improvo.sequences.images import list_images
from improvo.sequences.rates import frame_rate
from improvo.types import Float64, Trajectory

_CALENDAR = re.compile(r"20\d\d(0[1-9]|1[0-2])([0-2]\d|3[01])([01]\d|2[0-3])[0-5]\d")  # 202609011230...: no count
_SUBFOLDERS = ("images", "image", "rgb", "color", "colour", "frames", "imgs", "left", "cam0")


class ImageFolder(ImageFilesRecording):
    """Images in the folder itself or in its `images` (`rgb`, `color`, ...) folder."""

    format = "images"

    def __init__(self, path: Path, settings: SequenceSettings) -> None:
        self.path = path
        folder = _image_folder(path)
        if folder is None:
            raise InputError(f"{path}: has no images (png, jpg, tif, ...), nor an images folder with some")
        files, notes = one_kind(folder, list_images(folder))
        extras = path if folder != path or not _is_images_of(path) else path.parent
        self.calibration = self.own_calibration(lambda: folder_calibration(path), lambda: folder_calibration(extras))
        times_file = next((f / "times.txt" for f in (path, extras) if (f / "times.txt").is_file()), None)
        stamps = _stamps_in_names(files)
        truth_file = next((f for f in (path / "groundtruth.txt", extras / "groundtruth.txt") if f.is_file()), extras)
        truth, problems = read_trajectory_report(truth_file) if truth_file.is_file() else (None, ())
        notes += problems
        if times_file is not None and settings.fps is None:
            times, said = read_times(times_file)
            notes += said
            if len(times) != len(files):
                raise InputError(
                    f"{times_file}: has {len(times)} times for {len(files)} images; repair it, or give --fps"
                )
            order, repeated = increasing_order(times)
            if repeated:
                notes.append(f"{times_file}: {repeated} images repeat a time stamp and were left out")
            files, self.times = [files[row] for row in order], times[order]
        elif stamps is not None and settings.fps is None:
            order, _ = increasing_order(stamps)
            files, (self.times, unit) = [files[row] for row in order], in_seconds(stamps[order], of_video=False)
            notes.append(f"{path}: the names of the files are taken as time stamps in {unit or 'seconds'}")
        else:
            rate, note = frame_rate(self.calibration, settings, path)
            self.times = _frame_numbers(files) / rate
            if note is not None and truth is not None and len(truth) == len(files) and has_times(truth_file):
                self.times, note = truth.times, f"has no time stamps; those of {truth_file.name} are taken, row by row"
            notes += [f"{path}: {note}"] if note else []
        by_rows = truth is not None and not has_times(truth_file, beside=settings.fps is None)
        if truth is not None and by_rows and len(truth) == len(files):
            truth = Trajectory(self.times, truth.world_from_cam, truth.segment)
        self.ground_truth = truth
        self._images = ImageFiles(files, path)
        self.notes = (*notes, *self._images.notes)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return _image_folder(path) is not None


def _image_folder(path: Path) -> Path | None:
    """The folder itself, or its `images` folder if that has more images (there may be a `vignette.png` beside it)."""
    if not path.is_dir():
        return None
    found = [(folder, len(list_images(folder))) for folder in (path, *_subfolders(path))]
    found = [(folder, count) for folder, count in found if count]
    if not found:
        return None
    best = max(count for _, count in found[1:]) if len(found) > 1 else 0
    if found[0][0] == path and found[0][1] < min(best, 5):
        found = found[1:]
    return found[0][0]


def _subfolders(path: Path) -> list[Path]:
    return [path / name for name in _SUBFOLDERS if (path / name).is_dir()]


def _is_images_of(path: Path) -> bool:
    """Whether this is the `images` folder inside a recording's folder."""
    return path.name in _SUBFOLDERS


def _stamps_in_names(files: list[Path]) -> Float64 | None:
    """Time stamps that the names of the files are, in their own unit: dates since 1970, or long numbers that jump."""
    matches = [re.fullmatch(r"(?:.*[^\d.])?(\d{9,10}\.\d{1,9}|\d{12,19})", file.stem) for file in files]
    if len(files) < 2 or any(match is None or _CALENDAR.match(match.group(1)) for match in matches):
        return None
    texts = [match.group(1) for match in matches if match is not None]
    stamps = np.array([float(text) for text in texts], np.float64)
    date = unit_of(stamps, of_video=False) != "seconds" or all("." in text for text in texts)
    return stamps if date and (np.diff(np.sort(stamps)) > 0).all() else None


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
