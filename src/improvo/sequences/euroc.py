"""EuRoC MAV, the ASL layout (Burri et al. 2016): `mav0/cam0/data.csv`, `sensor.yaml`, nanosecond stamps.

Ground truth is that of a body sensor (`state_groundtruth_estimate0`, else `vicon0` or TUM-VI's `mocap0`), converted to
camera poses with the `T_BS` of the sensors. `--topic cam1` chooses another camera. TUM-VI has `dso/camchain.yaml`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.geometry.camera_files import load_calibration, parse_yaml
from improvo.geometry.se3 import inverse
from improvo.geometry.text_files import read_text
from improvo.geometry.trajectory_files import clean_poses, increasing_order, read_trajectory_report
from improvo.sequences.base import SequenceSettings
from improvo.sequences.image_files import ImageFiles, ImageFilesRecording
from improvo.sequences.images import list_images, listed_file
from improvo.types import Float64, Trajectory
from improvo.untrusted.numbers import numbers

_TRUTH = ("state_groundtruth_estimate0", "vicon0", "mocap0")


class EurocMav(ImageFilesRecording):
    """A folder with `mav0`, the `mav0` folder itself, or one of its camera folders."""

    format = "euroc"

    def __init__(self, path: Path, settings: SequenceSettings) -> None:
        self.path = path
        root = _mav_folder(path)
        if root is None:
            raise InputError(f"{path}: has no mav0/cam0 with images, so it is no EuRoC sequence")
        name = settings.topic or (path.name if _is_camera(path) else "cam0")
        folder = root / name
        if not _is_camera(folder):
            known = ", ".join(sorted(file.name for file in root.iterdir() if _is_camera(file)))
            raise InputError(f"{root}: has no camera `{name}`; --topic can be one of {known}")
        self.times, files, notes = _read_images(folder)
        self._images = ImageFiles(files, path)
        notes += self._images.notes
        sensor, chain = folder / "sensor.yaml", root.parent / "dso" / "camchain.yaml"
        body_from_cam: Float64 | None = np.eye(4)
        if sensor.is_file():
            self.calibration = self.own_calibration(lambda: load_calibration(str(sensor)))
            body_from_cam = self._place(lambda: _body_from_sensor(sensor))
        elif chain.is_file():
            self.calibration = self.own_calibration(lambda: load_calibration(str(chain), name))
            body_from_cam = self._place(lambda: _body_from_chain(chain, name))
        for truth in (root / name / "data.csv" for name in _TRUTH):
            if truth.is_file() and body_from_cam is not None:
                world_from_sensor, problems = read_trajectory_report(truth, "euroc")
                notes += problems
                body = truth.with_name("sensor.yaml")
                body_from_sensor = _body_from_sensor(body) if body.is_file() else np.eye(4)
                poses = world_from_sensor.world_from_cam @ inverse(body_from_sensor) @ body_from_cam
                self.ground_truth = Trajectory(world_from_sensor.times, poses, world_from_sensor.segment)
                break
        self.notes = tuple(notes)

    def _place(self, read: Callable[[], Float64]) -> Float64 | None:
        """Pose of the camera on the body; None if the file is broken, and then there is no ground truth."""
        try:
            return read()
        except InputError as error:
            self.calibration_error = self.calibration_error or error
            return None

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return path.is_dir() and _mav_folder(path) is not None


def _mav_folder(path: Path) -> Path | None:
    if _is_camera(path) and path.absolute().parent.name == "mav0":
        return path.absolute().parent
    for folder in (path / "mav0", path):
        if _is_camera(folder / "cam0") or _is_camera(folder / "cam1"):
            return folder
    return None


def _is_camera(folder: Path) -> bool:
    return (folder / "data").is_dir() and re.fullmatch(r"cam\d+", folder.name) is not None


def _read_images(folder: Path) -> tuple[Float64, list[Path], list[str]]:
    """Times and files of `data.csv`; without it, those that the file names say."""
    table = folder / "data.csv"
    rows, bad = [], 0
    if table.is_file():
        for number, line in enumerate(read_text(table, "a list of images", "copy it again").splitlines()):
            fields = [field.strip() for field in re.split(r"[,;\s]+", line.strip())]
            if not line.strip() or line.startswith("#") or (number == 0 and not fields[0].isdecimal()):
                continue
            stamp = _nanoseconds(fields[0])
            if len(fields) >= 2 and stamp is not None and fields[1]:
                rows.append((stamp, listed_file(folder / "data", fields[1])))
            else:
                bad += 1
    else:
        files = list_images(folder / "data")
        rows = [(stamp, file) for file in files if (stamp := _nanoseconds(file.stem)) is not None]
    if not rows:
        raise InputError(f"{table}: has no row `timestamp [ns],filename`; repair it")
    stamps = np.array([stamp for stamp, _ in rows], np.int64)
    order, repeated = increasing_order(stamps / 1e9)
    notes = [f"{table}: {bad} rows are not `timestamp,filename` and were left out"] if bad else []
    notes += [f"{table}: {repeated} rows repeat a time stamp and were left out"] if repeated else []
    return stamps[order] / 1e9, [rows[row][1] for row in order], notes


def _nanoseconds(text: str) -> int | None:
    """The stamp that a text is; None where it is none, or is later than 64 bits can say."""
    stamp = int(text) if re.fullmatch(r"[0-9]{1,19}", text) else None
    return None if stamp is None or stamp > np.iinfo(np.int64).max else stamp


def _body_from_sensor(path: Path) -> Float64:
    """T_BS of a `sensor.yaml`, the identity where it has none.

    Raises:
        InputError: not a rigid motion.
    """
    content = parse_yaml(read_text(path, "a calibration"), path)
    matrix = content.get("T_BS", {"data": np.eye(4).ravel().tolist()})
    return _rigid(matrix.get("data") if isinstance(matrix, dict) else matrix, path, "T_BS")


def _body_from_chain(path: Path, camera: str) -> Float64:
    content = parse_yaml(read_text(path, "a calibration"), path)
    entry = content.get(camera)
    matrix = entry.get("T_cam_imu") if isinstance(entry, dict) else None
    return np.eye(4) if matrix is None else inverse(_rigid(matrix, path, "T_cam_imu"))


def _rigid(values: object, path: Path, name: str) -> Float64:
    pose = clean_poses(numbers(values, 16).reshape(1, 4, 4))[0][0]
    if not np.isfinite(pose).all():
        raise InputError(f"{path}: {name} is no rigid 4x4 motion; repair it")
    return pose
