"""KITTI odometry (Geiger et al. 2012): `calib.txt`, `times.txt`, `image_0` (grey) or `image_2` (colour), poses.

Courses hand out shortened copies whose folders are `image_l` and `image_r` and whose `calib.txt` is a row of twelve
numbers a camera, without names.

Where `times.txt` has more rows than there are pictures, as in a copy that leaves frames out, pictures are told by their
numbers, which are those of the rows from 0 on.

Poses are those of camera 0: `poses.txt` in the folder, or `poses/NN.txt` beside the `sequences` folder. The pose of
another camera follows from its projection matrix, which is K [I | t].
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.geometry.camera_files import Calibration, folder_calibration
from improvo.geometry.se3 import inverse, rigid
from improvo.geometry.text_files import read_text
from improvo.geometry.trajectory_files import increasing_order, read_times, read_trajectory_report
from improvo.sequences.base import SequenceSettings
from improvo.sequences.image_files import ImageFiles, ImageFilesRecording
from improvo.sequences.images import list_images
from improvo.types import Float64, Int64, Trajectory
from improvo.untrusted.names import number_of

FPS = 10.0
_CAMERAS = {"image_0": 0, "image_2": 2, "image_1": 1, "image_3": 3, "image_l": 0, "image_r": 1}  # folder: number


class KittiOdometry(ImageFilesRecording):
    """A folder with `calib.txt` and `image_0` or `image_2`."""

    format = "kitti"

    def __init__(self, path: Path, settings: SequenceSettings) -> None:
        self.path = path
        folder = next((name for name in _CAMERAS if _has_images(path / name)), None)
        if folder is None:
            raise InputError(f"{path}: has no images in image_0 or image_2, so it is no KITTI odometry sequence")
        number = _CAMERAS[folder]
        files = list_images(path / folder)
        notes: list[str] = []
        poses_file = next((file for file in _pose_files(path) if file.is_file()), None)
        if (path / "times.txt").is_file() and settings.fps is None:
            stamps, said = read_times(path / "times.txt")
            notes += said
            if len(stamps) < len(files):
                counts = f"{len(stamps)} times for {len(files)} images"
                raise InputError(f"{path / 'times.txt'}: has {counts}; repair it or give --fps")
            rows = _rows_of(files, len(stamps))
            if len(stamps) > len(files):
                where = " at the end" if rows[-1] == len(files) - 1 else ""
                notes.append(f"{path}: {len(stamps) - len(files)} of {len(stamps)} images are missing{where}")
        else:
            rows = _rows_of(files, 0 if poses_file is None else _count(poses_file))
            stamps = np.arange(rows[-1] + 1) / (settings.fps or FPS)
        times = stamps[rows]
        order, repeated = increasing_order(times)
        notes += [f"{path}: {repeated} images repeat a time stamp and were left out"] if repeated else []
        self._images, self.times = ImageFiles([files[row] for row in order], path), times[order]
        notes += self._images.notes
        cam_from_cam0 = np.eye(4)
        published: list[Calibration] = []
        if (path / "calib.txt").is_file():
            try:
                calibration, cam_from_cam0 = _read_calibration(path / "calib.txt", number)
                published.append(calibration)
            except InputError as error:
                self.calibration_error = error
                notes += [f"{path}: poses are taken as those of these images' camera"] if number else []
        self.calibration = self.own_calibration(lambda: folder_calibration(path), lambda: next(iter(published), None))
        if self.calibration is not None:
            self.calibration_error = None
        if poses_file is not None:
            self.ground_truth, problems = _read_poses(poses_file, stamps, cam_from_cam0)
            notes += problems
        self.notes = tuple(notes)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return (path / "calib.txt").is_file() and any(_has_images(path / name) for name in _CAMERAS)


def _has_images(folder: Path) -> bool:
    return folder.is_dir() and bool(list_images(folder))


def _rows_of(files: list[Path], count: int) -> Int64:
    """(N,) which of `count` frames each picture is: by its number where pictures are missing, else one by one."""
    numbers = [number_of(file.stem) for file in files]
    rows = np.array([-1 if number is None else number for number in numbers], np.int64)
    known = len(files) < count and rows.min() >= 0 and rows.max() < count and (np.diff(rows) > 0).all()
    return rows if known else np.arange(len(files))


def _pose_files(path: Path) -> tuple[Path, ...]:
    absolute = path.absolute()
    return (path / "poses.txt", path / "groundtruth.txt", absolute.parent.parent / "poses" / f"{absolute.name}.txt")


def _read_calibration(path: Path, number: int) -> tuple[Calibration, Float64]:
    """The calibration of camera `number`, and cam_from_cam0 (4, 4)."""
    try:
        lines = read_text(path, "a calibration").splitlines()
        rows = {line.split(":")[0].strip(): line.split(":", 1)[1].split() for line in lines if ":" in line}
        rows = rows or {f"P{camera}": line.split() for camera, line in enumerate(filter(str.strip, lines))}
        row = rows.get(f"P{number}", rows.get(f"P_rect_0{number}"))
        projection = np.array(row or [], np.float64).reshape(3, 4)
        cam_from_cam0 = rigid(np.eye(3), np.linalg.solve(projection[:, :3], projection[:, 3]).astype(np.float64))
    except (ValueError, np.linalg.LinAlgError):
        raise InputError(f"{path}: has no row `P{number}:` with 12 numbers; repair it or give --camera") from None
    fx, fy, cx, cy = (float(projection[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    calibration = Calibration(str(path), (fx, fy, cx, cy))
    calibration.camera(1, 1)
    return calibration, cam_from_cam0


def _read_poses(path: Path, times: Float64, cam_from_cam0: Float64) -> tuple[Trajectory, tuple[str, ...]]:
    """Poses of the images' camera in camera 0's first frame."""
    world_from_cam0, problems = read_trajectory_report(path, times=_at_least(times, path))
    if (cam_from_cam0 == np.eye(4)).all():
        return world_from_cam0, problems
    poses = world_from_cam0.world_from_cam @ inverse(cam_from_cam0)
    return Trajectory(world_from_cam0.times, poses, world_from_cam0.segment), problems


def _at_least(times: Float64, path: Path) -> Float64:
    """The frames' times, continued where there are more poses than frames (a shortened copy)."""
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1 / FPS
    extra = max(0, _count(path) - len(times))
    return np.concatenate([times, times[-1] + step * np.arange(1, extra + 1)])


def _count(path: Path) -> int:
    """Rows of a file of poses."""
    return sum(1 for line in read_text(path, "poses").splitlines() if line.strip())
