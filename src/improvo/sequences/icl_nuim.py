"""ICL-NUIM (Handa et al. 2014), "TUM RGB-D compatible PNGs": `associations.txt`, `rgb`, `depth`, `*.gt.freiburg`.

Time stamps are frame numbers at 30 Hz. The published poses are those of a camera whose y axis points up, as the
negative fy of its intrinsics says; they are reflected here, so that K is ordinary and rotations stay rotations.

Many copies call the trajectory `groundtruth.txt`, as TUM RGB-D does. Read as TUM RGB-D, its rotations would be those of
a mirror image. Such a copy is known by its frame numbers in the place of times, and by its first pose, which all of the
data set's trajectories share but for the distance: `1 0 0 -2.25 0 0 0 1`.
"""

from __future__ import annotations

import re
from itertools import islice
from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.geometry.camera_files import Calibration, folder_calibration
from improvo.geometry.text_files import read_text
from improvo.geometry.trajectory_files import read_trajectory_report
from improvo.sequences.base import SequenceSettings
from improvo.sequences.image_files import ImageFiles, ImageFilesRecording
from improvo.sequences.images import list_images, listed_file, read_depth
from improvo.sequences.rates import depth_scale
from improvo.types import Float32, Trajectory
from improvo.untrusted.names import number_of

DEPTH_SCALE = 5000.0
FPS = 30.0
_HEADER = 20  # lines of comments before the first pose, at most
_UP_TO_DOWN = np.diag([1.0, -1.0, 1.0, 1.0])


class IclNuim(ImageFilesRecording):
    """A folder with `rgb`, `depth` and a `*.gt.freiburg` file, which may be named `groundtruth.txt`."""

    format = "icl"

    def __init__(self, path: Path, settings: SequenceSettings) -> None:
        self.path = path
        frames = _associations(path)
        if not frames:
            raise InputError(f"{path}: has no rgb images named by their frame numbers; unpack the archive again")
        self._numbers = sorted(frames)
        self._images = ImageFiles((frames[number][0] for number in self._numbers), path)
        self.notes = tuple(self._images.notes)
        self._depth = [frames[number][1] for number in self._numbers]
        rate = settings.fps or FPS
        self.times = np.array(self._numbers, np.float64) / rate
        published = Calibration("ICL-NUIM", (481.2, 480.0, 319.5, 239.5), size=(640, 480))
        self.calibration = self.own_calibration(lambda: folder_calibration(path), lambda: published)
        self._scale = depth_scale(self.calibration, settings, path) or DEPTH_SCALE
        truth = next(iter(sorted(path.glob("*.gt.freiburg"))), path / "groundtruth.txt" if _is_renamed(path) else None)
        if truth is not None:
            poses_up, problems = read_trajectory_report(truth, "tum", numbered=True)
            self.notes += problems
            poses = _UP_TO_DOWN @ poses_up.world_from_cam @ _UP_TO_DOWN
            self.ground_truth = Trajectory(poses_up.times / rate, poses)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return path.is_dir() and (path / "rgb").is_dir() and (any(path.glob("*.gt.freiburg")) or _is_renamed(path))

    def depth(self, index: int) -> Float32 | None:
        file = self._depth[index]
        return read_depth(file, self._scale) if file is not None and file.is_file() else None


def _associations(path: Path) -> dict[int, tuple[Path, Path | None]]:
    """Frame number -> image and depth, by `associations.txt` or, without it, by the file names."""
    table = path / "associations.txt"
    frames: dict[int, tuple[Path, Path | None]] = {}
    if table.is_file():
        for line in read_text(table, "a list of images").splitlines():
            fields = line.split()
            if len(fields) < 4 or line.startswith("#"):
                continue
            # either pair may come first: rows are "number file number file"
            pair = {re.split(r"[/\\]", name)[0]: (number, name) for number, name in (fields[:2], fields[2:4])}
            if "rgb" in pair and _is_number(pair["rgb"][0]):
                depth = listed_file(path, pair["depth"][1]) if "depth" in pair else None
                frames[int(float(pair["rgb"][0]))] = (listed_file(path, pair["rgb"][1]), depth)
    if not frames:
        for file in list_images(path / "rgb"):
            if (number := number_of(file.stem)) is not None:
                frames[number] = (file, path / "depth" / f"{file.stem}.png")
    return frames


def _is_renamed(path: Path) -> bool:
    """Whether `groundtruth.txt` is a trajectory of this data set."""
    truth = path / "groundtruth.txt"
    if not (truth.is_file() and (path / "associations.txt").is_file()) or (path / "rgb.txt").is_file():
        return False
    with truth.open(encoding="utf-8", errors="replace") as file:
        first = next((line for line in islice(file, _HEADER) if line.strip() and not line.startswith("#")), "")
    try:
        stamp, x, y, z, *quat_xyzw = (float(field) for field in first.split())
    except ValueError:
        return False
    numbered = all(number_of(image.stem) == number for number, (image, _) in _associations(path).items())
    return numbered and stamp in (0, 1) and x == y == 0 > z and quat_xyzw == [0, 0, 0, 1]


def _is_number(text: str) -> bool:
    try:
        return np.isfinite(float(text)) and 0 <= float(text) < 1e12
    except ValueError:
        return False
