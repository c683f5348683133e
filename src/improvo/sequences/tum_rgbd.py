"""TUM RGB-D (Sturm et al. 2012): `rgb.txt`, `depth.txt`, `groundtruth.txt`, time stamps in seconds.

Depth is 16 bit, 5000 per metre unless `camera.yaml` says otherwise, registered to colour. The original data set has no
calibration file; the published cameras are used where the folder's name tells which Kinect it was.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.geometry.camera_files import Calibration, folder_calibration
from improvo.geometry.text_files import read_text
from improvo.geometry.time_units import in_seconds, note_of
from improvo.geometry.trajectory_files import increasing_order, read_trajectory_report
from improvo.sequences.association import nearest
from improvo.sequences.base import SequenceSettings
from improvo.sequences.image_files import ImageFiles, ImageFilesRecording
from improvo.sequences.images import listed_file, read_depth
from improvo.sequences.rates import depth_scale
from improvo.types import Float32, Float64

DEPTH_SCALE = 5000.0
_DECIMAL_COMMA = re.compile(r"^(\s*\d+),(\d+)(?=[\s;]+\S)")  # of a time stamp before a separated file name
_PUBLISHED = {  # the data set's page, "Intrinsic Camera Calibration of the Kinect"
    "1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": ((535.4, 539.2, 320.1, 247.6), ()),
}


class TumRgbd(ImageFilesRecording):
    """A folder with `rgb.txt`, or with the `associations.txt` that other tools make of both lists."""

    format = "tum"

    def __init__(self, path: Path, settings: SequenceSettings) -> None:
        self.path = path
        pairs = None if (path / "rgb.txt").is_file() else _pairs_file(path)
        self.times, files, notes = _read_list(pairs or path / "rgb.txt", "rgb")
        self.calibration = self.own_calibration(lambda: folder_calibration(path), lambda: _published(path))
        self._scale = depth_scale(self.calibration, settings, path) or DEPTH_SCALE
        self._depth: list[Path] = []
        self._depth_row = np.full(len(self.times), -1, np.int64)
        if pairs is not None or (path / "depth.txt").is_file():
            depth_times, self._depth, depth_notes = _read_list(pairs or path / "depth.txt", "depth")
            self._depth_row = nearest(self.times, depth_times)
            notes += depth_notes
            without = int((self._depth_row < 0).sum())
            if without:
                notes.append(
                    f"{path}: depth for {len(self.times) - without} of {len(self.times)} images (within 0.02 s)"
                )
        if (path / "groundtruth.txt").is_file():
            self.ground_truth, problems = read_trajectory_report(path / "groundtruth.txt")
            notes += problems
        self._images = ImageFiles(files, path)
        self.notes = (*notes, *self._images.notes)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return (path / "rgb.txt").is_file() or (path.is_dir() and _pairs_file(path) is not None)

    def depth(self, index: int) -> Float32 | None:
        row = self._depth_row[index]
        return None if row < 0 else read_depth(self._depth[row], self._scale)


def _pairs_file(path: Path) -> Path | None:
    """The list of `time rgb/file time depth/file` rows, in either order."""
    names = ("associations.txt", "associate.txt", "associated.txt", "association.txt", "assoc.txt")
    return next((path / name for name in names if (path / name).is_file()), None)


def _read_list(path: Path, kind: str) -> tuple[Float64, list[Path], list[str]]:
    """Times (N,), increasing, and files of an `rgb.txt` or of the `kind` in a list of pairs; notes on bad rows.

    Raises:
        InputError: the file cannot be read or has no row `timestamp filename`.
    """
    lines = read_text(path, "a list of images", "it must list `timestamp filename` rows").splitlines()
    in_pairs = path.name != f"{kind}.txt"
    times, files, bad = [], [], 0
    for line in lines:
        line = _DECIMAL_COMMA.sub(r"\1.\2", line)
        fields = line.replace(",", " ").split() if in_pairs else line.replace(",", " ").split(maxsplit=1)
        if not fields or fields[0].startswith("#"):
            continue
        if len(fields) == 4 and re.split(r"[/\\]", fields[3])[0] == kind:
            fields = fields[2:4]
        try:
            time = float(fields[0])
        except ValueError:
            time = float("nan")
        if len(fields) < 2 or not np.isfinite(time):
            bad += 1
            continue
        times.append(time)
        files.append(listed_file(path.parent, fields[1]))
    if not times:
        raise InputError(f"{path}: has no row `timestamp filename`; repair it or give the image folder itself")
    stamps, unit = in_seconds(np.asarray(times, np.float64))
    order, repeated = increasing_order(stamps)
    notes = [f"{path}: {bad} rows are not `timestamp filename` and were left out"] if bad else []
    notes += [f"{path}: {repeated} rows repeat a time stamp and were left out"] if repeated else []
    notes += [f"{path}: {note_of(unit)}"] if unit else []
    return stamps[order], [files[row] for row in order], notes


def _published(path: Path) -> Calibration | None:
    match = re.search(r"(?:freiburg|fr)([123])(?![0-9])", path.absolute().name)
    if match is None:
        return None
    intrinsics, distortion = _PUBLISHED[match.group(1)]
    return Calibration(f"TUM RGB-D freiburg{match.group(1)}", intrinsics, distortion, size=(640, 480))
