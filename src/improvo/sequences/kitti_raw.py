"""A drive of KITTI's raw data (Geiger et al. 2013): `image_02/data`, `timestamps.txt`, `oxts`, calibration of the day.

The calibration files lie in the folder of the day, above the drive. Pictures of a `_sync` drive are rectified, those of
an `_extract` drive are not; their size tells which. Ground truth is that of the GPS and inertial unit, converted to
camera poses; its world is a Mercator map, east, north and up in metres.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.geometry.camera_files import Calibration, folder_calibration, load_calibration
from improvo.geometry.se3 import inverse, rigid, so3_exp
from improvo.geometry.text_files import read_text
from improvo.geometry.trajectory_files import clean_poses, increasing_order, read_times
from improvo.sequences.base import SequenceSettings, UnreadableFrameError
from improvo.sequences.image_files import ImageFiles, ImageFilesRecording
from improvo.sequences.images import list_images
from improvo.types import Float64, Trajectory
from improvo.untrusted.names import number_of

FPS = 10.0
EARTH_RADIUS = 6378137.0  # metres
_PROBES = 5  # pictures tried for their size
_CAMERAS = ("image_02", "image_00", "image_03", "image_01")  # the left colour camera first, then the left grey one


class KittiRaw(ImageFilesRecording):
    """The folder of one drive; `--topic image_00` chooses another camera."""

    format = "kitti-raw"

    def __init__(self, path: Path, settings: SequenceSettings) -> None:
        self.path = path
        present = [name for name in _CAMERAS if _is_camera(path / name)]
        name = settings.topic or next(iter(present), None)
        if name is None or name not in present:
            raise InputError(f"{path}: has no camera {name or 'image_02'}; --topic can be {', '.join(present) or '-'}")
        files, notes = list_images(path / name / "data"), []
        stamps_file = path / name / "timestamps.txt"
        times = np.arange(len(files)) / (settings.fps or FPS)
        if stamps_file.is_file() and settings.fps is None:
            times, _ = read_times(stamps_file)
            # a lost picture still has a time stamp, so files are numbered by row
            rows = np.array([len(times) if number_of(file.stem) is None else number_of(file.stem) for file in files])
            if (rows >= len(times)).any():
                raise InputError(
                    f"{stamps_file}: has {len(times)} times for {len(files)} images; repair it or give --fps"
                )
            times = times[rows]
        order, repeated = increasing_order(times)
        notes += [f"{stamps_file}: {repeated} images repeat a time stamp and were left out"] if repeated else []
        self._images, self.times = ImageFiles([files[row] for row in order], path), times[order]
        day = next((f for f in (path, path.absolute().parent) if (f / "calib_cam_to_cam.txt").is_file()), None)
        number = name[-2:]
        self.calibration = self.own_calibration(lambda: folder_calibration(path), lambda: _of_the_day(day, number))
        if day is not None and (path / "oxts" / "data").is_dir():
            self.ground_truth, problems = _inertial_poses(path / "oxts", day, number, self._size())
            notes += problems
        self.notes = (*notes, *self._images.notes)

    def _size(self) -> tuple[int, int] | None:
        """Width and height of the first picture that can be read."""
        for index in range(min(len(self._images), _PROBES)):
            try:
                height, width = self._images.read(index).shape[:2]
            except UnreadableFrameError:
                continue
            return width, height
        return None

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return path.is_dir() and any(_is_camera(path / name) for name in _CAMERAS)


def _is_camera(folder: Path) -> bool:
    return (folder / "data").is_dir() and bool(list_images(folder / "data"))


def _of_the_day(day: Path | None, number: str) -> Calibration | None:
    return None if day is None else load_calibration(str(day / "calib_cam_to_cam.txt"), number)


def _inertial_poses(
    folder: Path, day: Path, number: str, size: tuple[int, int] | None
) -> tuple[Trajectory | None, list[str]]:
    """World_from_cam of every row of the GPS and inertial unit; a note where the calibration for it is missing."""
    try:
        cam_from_imu = _cam_from_imu(day, number, size)
        times, _ = read_times(folder / "timestamps.txt")
    except InputError as error:
        return None, [f"{folder}: is left out, so there is no ground truth ({str(error).split(';')[0]})"]
    files = sorted(file for file in (folder / "data").iterdir() if file.suffix == ".txt")
    numbered = [(number_of(file.stem), file) for file in files]
    known = [(number, file) for number, file in numbered if number is not None and number < len(times)]
    if not known:
        return None, []
    numbers = [number for number, _ in known]
    rows = np.array([_oxts_row(file) for _, file in known])
    whole = int(np.argmax(np.isfinite(rows).all(axis=1)))  # the first that is not damaged
    scale = np.cos(np.radians(rows[whole, 0]))
    east = scale * np.radians(rows[:, 1]) * EARTH_RADIUS
    north = scale * EARTH_RADIUS * np.log(np.tan(np.radians(90 + rows[:, 0]) / 2))
    place = np.stack([east, north, rows[:, 2]], axis=1)
    axes = np.eye(3)
    turn = [so3_exp(rows[:, 3 + axis, None] * axes[axis]) for axis in range(3)]  # roll, pitch, yaw
    world_from_imu = rigid(turn[2] @ turn[1] @ turn[0], place - place[whole])
    poses = clean_poses(world_from_imu @ inverse(cam_from_imu))[0]
    order, _ = increasing_order(times[numbers])
    stamps = times[numbers][order]
    return (Trajectory(stamps, poses[order]) if np.isfinite(poses).any() else None), []


def _oxts_row(path: Path) -> list[float]:
    """Latitude, longitude in degrees, altitude in metres, roll, pitch, yaw in radians; NaN where it cannot be read."""
    fields = read_text(path, "a row of the inertial unit").split()
    try:
        return [float(field) for field in fields[:6]] if len(fields) >= 6 else [np.nan] * 6
    except ValueError:
        return [np.nan] * 6


def _cam_from_imu(day: Path, number: str, size: tuple[int, int] | None) -> Float64:
    """From the inertial unit over the laser scanner to the camera: the rectified one, or the one as it was built in.

    Args:
        day: folder of the calibration.
        number: of the camera.
        size: width and height of its pictures, which tell whether they are rectified.
    """
    rows = _rows(day / "calib_cam_to_cam.txt")
    if _size_of(rows, f"S_rect_{number}", day) not in (None, size) and _size_of(rows, f"S_{number}", day) == size:
        cam_from_cam0 = rigid(_numbers(rows, f"R_{number}", (3, 3), day), _numbers(rows, f"T_{number}", (3,), day))
    else:
        projection = _numbers(rows, f"P_rect_{number}", (3, 4), day)
        shift = np.linalg.solve(projection[:, :3], projection[:, 3]).astype(np.float64)
        cam_from_cam0 = rigid(np.eye(3), shift) @ rigid(_numbers(rows, "R_rect_00", (3, 3), day), np.zeros(3))
    motions = []
    for name in ("calib_velo_to_cam.txt", "calib_imu_to_velo.txt"):
        rows = _rows(day / name)
        motions.append(rigid(_numbers(rows, "R", (3, 3), day), _numbers(rows, "T", (3,), day)))
    return cam_from_cam0 @ motions[0] @ motions[1]


def _size_of(rows: dict[str, list[str]], name: str, day: Path) -> tuple[int, int] | None:
    """Width and height in a row of the calibration; None without the row."""
    if name not in rows:
        return None
    width, height = _numbers(rows, name, (2,), day).tolist()
    return round(width), round(height)


def _rows(path: Path) -> dict[str, list[str]]:
    lines = (line.partition(":") for line in read_text(path, "a calibration").splitlines())
    return {name.strip(): values.split() for name, _, values in lines}


def _numbers(rows: dict[str, list[str]], name: str, shape: tuple[int, ...], day: Path) -> Float64:
    try:
        return np.array(rows[name], np.float64).reshape(shape)
    except (KeyError, ValueError):
        raise InputError(f"{day}: its calibration has no row `{name}:` of {shape}; copy it again") from None
