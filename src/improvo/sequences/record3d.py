"""Record3D's export: an `.r3d` file (a ZIP archive), the unpacked archive, or its `rgb` folder with `metadata.json`.

Depth inside an archive is LZFSE-compressed and needs the extra `record3d`; without it the recording has no depth.
"""

from __future__ import annotations

import zipfile
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from improvo.errors import InputError, installed
from improvo.geometry.se3 import rigid, rotation_from_quat_xyzw
from improvo.sequences.base import Recording, SequenceSettings, UnreadableFrameError
from improvo.sequences.images import decode, depth_in_metres, depth_of_size, natural_key
from improvo.sequences.varying_camera import median_calibration, read_json, trajectory_from_opengl
from improvo.types import Float32, Float64, UInt8
from improvo.untrusted.arrays import FAULTS
from improvo.untrusted.limits import MAX_ARRAY_BYTES, MAX_JSON_BYTES, MAX_PIXELS
from improvo.untrusted.numbers import numbers
from improvo.untrusted.paths import check_is_file
from improvo.untrusted.text import reason


class Record3d(Recording):
    """An `.r3d` file or its unpacked folder."""

    format = "record3d"

    def __init__(self, path: Path, settings: SequenceSettings) -> None:
        self.path = path
        self._files = _Archive(path) if path.is_file() else _Folder(path)
        name = next((name for name in ("metadata", "metadata.json") if self._files.has(name)), None)
        if name is None:
            raise InputError(f"{path}: has no metadata, so it is no Record3D export; export it again")
        try:
            metadata = read_json(path / name, self._files.read(name, MAX_JSON_BYTES + 1))
        except UnreadableFrameError as error:
            raise InputError(f"{path}: its metadata {error}; export it again") from None
        folder = next((f for f in ("rgbd", "rgb") if self._files.list(f, (".jpg", ".png"))), None)
        if folder is None:
            raise InputError(f"{path}: has no images in rgbd or rgb; export it again")
        self._images = self._files.list(folder, (".jpg", ".png"))
        count = len(self._images)
        rate = settings.fps or _positive(metadata.get("fps")) or 30.0
        stamps = numbers(metadata.get("frameTimestamps"), count)
        stamped = settings.fps is None and np.isfinite(stamps).all() and (np.diff(stamps) > 0).all()
        self.times = stamps if stamped else np.arange(count) / rate
        size_numbers = numbers([metadata.get("w"), metadata.get("h")], 2)
        size = _size(size_numbers)
        notes: list[str] = []
        rows = _intrinsics(metadata, count)
        self.calibration = self.own_calibration(lambda: median_calibration(str(path), rows, size=size, notes=notes))
        self._size = size
        depth_size = numbers([metadata.get("dw"), metadata.get("dh")], 2)
        self._depth_size = _size(depth_size)
        poses = _poses(metadata.get("poses"), count)
        self.ground_truth, problems = trajectory_from_opengl(str(path), self.times, poses)
        if self._files.has(self._depth_name(0, ".depth")) and _lzfse() is None:
            problems.append(f"{path}: its depth is left out; pip install 'improvo[record3d]' to read it")
        self.notes = (*notes, *problems)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        if path.is_file():
            return path.suffix.lower() == ".r3d"
        return any((path / name).is_file() for name in ("metadata", "metadata.json")) and any(
            (path / folder).is_dir() for folder in ("rgbd", "rgb")
        )

    def source(self, index: int) -> str:
        return f"{self.path}#{self._images[index]}" if self.path.is_file() else str(self.path / self._images[index])

    def image(self, index: int) -> UInt8:
        return decode(self._files.read(self._images[index]), cv2.IMREAD_ANYCOLOR).astype(np.uint8, copy=False)

    def depth(self, index: int) -> Float32 | None:
        """Metres as float32; the same view as the image at a lower resolution."""
        name = self._depth_name(index, ".depth")
        decompress = _lzfse()
        if decompress is None or self._depth_size is None or not self._files.has(name):
            return None
        width, height = self._depth_size
        try:
            packed = self._files.read(name)
            if len(packed) > 2 * 4 * width * height + 4096:
                raise UnreadableFrameError("has more bytes of depth than its size")
            data = decompress(packed)
        except UnreadableFrameError:
            raise
        except Exception:  # the codec's own error type is not public
            raise UnreadableFrameError("the depth cannot be decompressed") from None
        if len(data) != 4 * width * height:
            raise UnreadableFrameError(f"has {len(data)} bytes of depth, not {4 * width * height}")
        depth = depth_in_metres(np.frombuffer(data, "<f4").reshape(height, width), 1.0)
        return depth_of_size(depth, self._size)

    def _depth_name(self, index: int, ending: str) -> str:
        return str(Path(self._images[index]).with_suffix(ending).as_posix())


class _Folder:
    """Files of an unpacked export, by their names in the archive."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def has(self, name: str) -> bool:
        return (self._path / name).is_file()

    def list(self, folder: str, endings: tuple[str, ...]) -> list[str]:
        files = (self._path / folder).iterdir() if (self._path / folder).is_dir() else ()
        names = [f"{folder}/{file.name}" for file in files if file.name.lower().endswith(endings)]
        return sorted(names, key=natural_key)

    def read(self, name: str, limit: int = MAX_ARRAY_BYTES) -> bytes:
        try:
            with check_is_file(self._path / name).open("rb") as file:
                return file.read(limit)
        except InputError:
            raise UnreadableFrameError("is a pipe or a device, not a file") from None
        except OSError as error:
            raise UnreadableFrameError(reason(error)) from None


class _Archive:
    """The same, inside the ZIP archive."""

    def __init__(self, path: Path) -> None:
        try:
            self._zip = zipfile.ZipFile(path)
        except FAULTS as error:
            raise InputError(f"{path}: is no complete .r3d archive ({reason(error)}); export it again") from None
        self._names = set(self._zip.namelist())

    def has(self, name: str) -> bool:
        return name in self._names

    def list(self, folder: str, endings: tuple[str, ...]) -> list[str]:
        names = [n for n in self._names if n.startswith(f"{folder}/") and n.lower().endswith(endings)]
        return sorted(names, key=natural_key)

    def read(self, name: str, limit: int = MAX_ARRAY_BYTES) -> bytes:
        try:
            with self._zip.open(name) as file:
                return file.read(limit)
        except Exception as error:  # of many kinds: zip's own, and what its decompressors raise
            raise UnreadableFrameError(f"cannot be unpacked ({reason(error)})") from None


def _intrinsics(metadata: dict[str, Any], count: int) -> Float64:
    """fx, fy, cx, cy (N, 4): per frame where the recorder kept them, else from the column-major `K`."""
    rows = metadata.get("perFrameIntrinsicCoeffs")
    if isinstance(rows, list) and len(rows) >= 1:
        return np.stack([numbers(row, 4) for row in rows[:count]])
    matrix = numbers(metadata.get("K"), 9)
    return np.array([[matrix[0], matrix[4], matrix[6], matrix[7]]])


def _poses(rows: Any, count: int) -> Float64:
    """(N, 4, 4) from rows qx, qy, qz, qw, tx, ty, tz; NaN where there is none."""
    poses = np.full((count, 4, 4), np.nan)
    if not isinstance(rows, list):
        return poses
    for i, row in enumerate(rows[:count]):
        values = numbers(row, 7)
        if np.isfinite(values).all() and np.linalg.norm(values[:4]) > 1e-6:
            poses[i] = rigid(rotation_from_quat_xyzw(values[:4]), values[4:])
    return poses


def _size(sides: Float64) -> tuple[int, int] | None:
    """Width and height; None where they cannot be."""
    if not ((sides >= 1) & (sides <= MAX_PIXELS)).all() or sides.prod() > MAX_PIXELS:
        return None
    return int(sides[0]), int(sides[1])


def _positive(value: Any) -> float | None:
    number = float(numbers(value, 1)[0])
    return number if number > 0 else None


def _lzfse() -> Any:
    """The decompressor, None where its package is not installed."""
    return import_module("liblzfse").decompress if installed("liblzfse") else None
