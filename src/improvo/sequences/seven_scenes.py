"""7-Scenes (Shotton et al. 2013): `frame-000000.color.png`, `.depth.png`, `.pose.txt`.

Depth is in millimetres, 0 or 65535 where missing. In the original data set it is that of the depth camera, not
registered to colour; with a `camera.yaml` it is taken to be registered.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.geometry.camera_files import Calibration, folder_calibration
from improvo.geometry.trajectory_files import clean_poses
from improvo.sequences.base import SequenceSettings
from improvo.sequences.image_files import ImageFiles, ImageFilesRecording
from improvo.sequences.images import IMAGE_SUFFIXES, read_depth
from improvo.sequences.rates import depth_scale, frame_rate
from improvo.sequences.scannet_folder import read_matrix
from improvo.types import Float32, Trajectory

DEPTH_SCALE = 1000.0
FPS = 30.0
_COLOUR = re.compile(r"frame-(\d{1,9})\.color\.(\w+)")


class SevenScenes(ImageFilesRecording):
    """A folder of `frame-NNNNNN.color.*` files."""

    format = "7scenes"

    def __init__(self, path: Path, settings: SequenceSettings) -> None:
        self.path = path
        # of two files of one number the later by name, whose picture is PNG, not JPEG
        by_name = sorted(_colour_files(path), key=lambda each: each[0].name)
        found = {int(match.group(1)): file for file, match in by_name}
        if not found:
            raise InputError(f"{path}: has no frame-NNNNNN.color.png files, so it is no 7-Scenes sequence")
        self._numbers = sorted(found)
        self._images = ImageFiles((found[number] for number in self._numbers), path)
        self.calibration = self.own_calibration(lambda: folder_calibration(path))
        notes = list(self._images.notes)
        has_depth = any(self._beside(row, "depth.png").is_file() for row in range(min(len(self._images), 10)))
        if self.calibration is None and self.calibration_error is None:
            self.calibration = Calibration("7-Scenes default", (525.0, 525.0, 319.5, 239.5), size=(640, 480))
            notes.append(f"{path}: has no camera.yaml; a Kinect's usual focal length of 525 px assumed")
            if has_depth:
                notes.append(f"{path}: original 7-Scenes depth is not registered to colour: do not trust it at edges")
        self._scale = depth_scale(self.calibration, settings, path) or DEPTH_SCALE
        rate, assumed = frame_rate(self.calibration, settings, path)
        rate = FPS if assumed else rate
        self.times = (np.array(self._numbers, np.float64) - self._numbers[0]) / rate
        self.ground_truth, problems = self._read_poses()
        self.notes = (*notes, *problems)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return path.is_dir() and next(_colour_files(path), None) is not None

    def depth(self, index: int) -> Float32 | None:
        file = self._beside(index, "depth.png")
        return read_depth(file, self._scale) if file.is_file() else None

    def _beside(self, index: int, ending: str) -> Path:
        image = self._images.files[index]
        return image.with_name(f"{image.name.split('.')[0]}.{ending}")

    def _read_poses(self) -> tuple[Trajectory | None, list[str]]:
        matrices = np.full((len(self._images), 4, 4), np.nan)
        files = [self._beside(row, "pose.txt") for row in range(len(self._images))]
        present = [row for row, file in enumerate(files) if file.is_file()]
        if not present:
            return None, []
        for row in present:
            matrices[row] = read_matrix(files[row])
        poses, not_finite, not_rigid = clean_poses(matrices)
        missing = set(range(len(files))) - set(present)
        bad = [files[row].name for row in sorted({*not_finite.tolist(), *not_rigid.tolist()} - missing)]
        if len(bad) == len(present):
            raise InputError(
                f"{self.path}: none of the {len(present)} pose files holds a rigid 4x4 pose; repair or remove them"
            )
        shown = ", ".join(bad[:5]) + (", ..." if len(bad) > 5 else "")
        problems = [f"{self.path}: {len(bad)} pose files hold no rigid pose ({shown})"] if bad else []
        return Trajectory(self.times, poses), problems


def _colour_files(path: Path) -> Iterator[tuple[Path, re.Match[str]]]:
    for file in path.iterdir():
        match = _COLOUR.fullmatch(file.name)
        if match and file.suffix.lower() in IMAGE_SUFFIXES:
            yield file, match
