"""ScanNet `.sens` (Dai et al. 2017): one file of compressed colour and depth frames with poses, read by seeking.

Opening reads only the frame headers and decodes nothing. Written from the published description of the format (version
4). Depth is registered to the colour camera with the intrinsics and extrinsics of both. Time stamps are microseconds;
where they do not increase, 30 frames per second are assumed.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np

from improvo.errors import InputError
from improvo.geometry.camera import Camera
from improvo.geometry.camera_files import Calibration
from improvo.geometry.camera_files.calibration import checked
from improvo.geometry.trajectory_files import clean_poses
from improvo.sequences.base import Recording, SequenceSettings, UnreadableFrameError
from improvo.sequences.images import decode, depth_in_metres
from improvo.sequences.registration import intrinsics_of, register_depth, relative_extrinsics
from improvo.types import Float32, Int64, Trajectory, UInt8
from improvo.untrusted.decompression import decompress
from improvo.untrusted.limits import MAX_PICTURE_BYTES

FPS = 30.0
_FRAME = struct.Struct("<16f4Q")  # camera-to-world, colour and depth time, colour and depth bytes
_BYTES = struct.Struct("<2Q")  # the last two of them
_SIZES = struct.Struct("<2i4IfQ")  # compressions, colour and depth sizes, depth values per metre, frames
_COLOUR = {0: "raw", 1: "png", 2: "jpeg"}
_DEPTH = {0: "raw", 1: "zlib"}
_MAX_SIDE = 16384
_DEFLATED = 1100  # bytes that one byte of zlib can become, at most


class ScanNetSens(Recording):
    """A `.sens` file."""

    format = "sens"

    def __init__(self, path: Path, settings: SequenceSettings) -> None:
        self.path = path
        try:
            self._file: BinaryIO = path.open("rb", buffering=0)
        except OSError as error:
            raise InputError(f"{path}: cannot be opened ({error.strerror}); check the path") from None
        self._length = path.stat().st_size
        claimed = self._read_header()
        frames, self._offsets, cut = self._hop(claimed)
        if len(frames) == 0:
            raise InputError(f"{path}: holds no complete frame (truncated?); copy it again")
        self._colour_bytes, self._depth_bytes = frames["colour"], frames["depth"]
        notes = [f"{path}: is cut short: {len(frames)} of {claimed} frames are there"] if cut else []
        self.times = frames["time"] / 1e6
        if settings.fps is not None:
            self.times = np.arange(len(frames)) / settings.fps
        elif len(frames) > 1 and not (np.diff(self.times) > 0).all():
            self.times = np.arange(len(frames)) / FPS
            notes.append(f"{path}: time stamps do not increase; {FPS:g} frames per second assumed, --fps changes it")
        poses, not_finite, not_rigid = clean_poses(frames["pose"].reshape(-1, 4, 4).astype(np.float64))
        if len(not_finite) or len(not_rigid):
            named = ", ".join(str(row) for row in np.union1d(not_finite, not_rigid)[:5])
            notes.append(f"{path}: {len(not_finite) + len(not_rigid)} frames hold no rigid pose ({named}, ...)")
        if np.isfinite(poses).any():
            self.ground_truth = Trajectory(self.times, poses @ self._base_from_colour)
        self.notes = tuple(notes)

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return path.is_file() and path.suffix.lower() == ".sens"

    def __del__(self) -> None:
        if file := getattr(self, "_file", None):
            file.close()

    def source(self, index: int) -> str:
        return f"{self.path}#{index}"

    def image(self, index: int) -> UInt8:
        data = self._bytes(int(self._offsets[index]), int(self._colour_bytes[index]))
        if self._colour_compression == "raw":
            width, height = self._colour_size
            if len(data) != 3 * width * height:
                raise UnreadableFrameError(f"has {len(data)} bytes of raw colour, not {3 * width * height}")
            return np.asarray(cv2.cvtColor(np.frombuffer(data, np.uint8).reshape(height, width, 3), cv2.COLOR_RGB2BGR))
        return decode(data, cv2.IMREAD_ANYCOLOR).astype(np.uint8, copy=False)

    def depth(self, index: int) -> Float32 | None:
        size = int(self._depth_bytes[index])
        if size == 0 or self._depth_camera is None or self._depth_compression is None:
            return None
        data = self._bytes(int(self._offsets[index] + self._colour_bytes[index]), size)
        expected = 2 * self._depth_camera.width * self._depth_camera.height
        if expected > _DEFLATED * size:
            raise UnreadableFrameError(f"has {size} bytes for {expected} bytes of depth")
        if self._depth_compression == "zlib":
            try:
                data = decompress(zlib.decompressobj, data, expected)
            except (zlib.error, ValueError):
                raise UnreadableFrameError("the depth cannot be decompressed") from None
        if len(data) != expected:
            raise UnreadableFrameError(f"has {len(data)} bytes of depth, not {expected}")
        values = np.frombuffer(data, "<u2").reshape(self._depth_camera.height, self._depth_camera.width)
        own = depth_in_metres(values, self._depth_scale)
        if self.calibration is None:
            return own if own.shape == self._colour_size[::-1] else None
        camera = self.calibration.camera(*self._colour_size)
        return register_depth(own, self._depth_camera, camera.pinhole(), self._colour_from_depth)

    def _bytes(self, offset: int, count: int) -> bytes:
        if count > MAX_PICTURE_BYTES:
            raise UnreadableFrameError(f"has {count} bytes, too many for a picture")
        self._file.seek(offset)
        data = self._file.read(count)
        if len(data) != count:
            raise UnreadableFrameError("the frame is cut short")
        return data

    def _read_header(self) -> int:
        """Calibrations, sizes and compressions; returns the number of frames that the header claims."""
        try:
            version, name_bytes = struct.unpack("<IQ", self._file.read(12))
            if version != 4 or name_bytes > 4096:
                raise InputError(f"{self.path}: is no ScanNet .sens file of version 4; export it again")
            self._file.read(name_bytes)
            matrices = np.frombuffer(self._file.read(256), "<f4").reshape(4, 4, 4).astype(np.float64)
            colour_kind, depth_kind, *sizes, scale, claimed = _SIZES.unpack(self._file.read(_SIZES.size))
        except (struct.error, ValueError):
            raise InputError(f"{self.path}: ends within its header; copy it again") from None
        if not all(0 < side <= _MAX_SIDE for side in sizes[:2]) or not all(
            0 <= side <= _MAX_SIDE for side in sizes[2:]
        ):
            raise InputError(f"{self.path}: its header claims images of {sizes}; copy it again")
        if colour_kind not in _COLOUR:
            raise InputError(f"{self.path}: colour compression {colour_kind} is unknown; export it as JPEG, PNG or raw")
        intrinsic_colour, extrinsic_colour, intrinsic_depth, extrinsic_depth = matrices
        self._colour_compression, self._depth_compression = _COLOUR[colour_kind], _DEPTH.get(depth_kind)
        self._colour_size = (sizes[0], sizes[1])
        self._depth_scale = scale if np.isfinite(scale) and scale > 0 else 1000.0
        published = Calibration(str(self.path), intrinsics_of(intrinsic_colour), size=self._colour_size)
        self.calibration = self.own_calibration(lambda: checked(published))
        self._depth_camera: Camera | None = None
        usable = min(intrinsic_depth[0, 0], intrinsic_depth[1, 1]) > 0 and np.isfinite(intrinsic_depth).all()
        if sizes[2] and sizes[3] and usable:
            self._depth_camera = Camera(sizes[2], sizes[3], *intrinsics_of(intrinsic_depth))
        self._base_from_colour, self._colour_from_depth = relative_extrinsics(extrinsic_colour, extrinsic_depth)
        return int(claimed)

    def _hop(self, claimed: int) -> tuple[np.ndarray, Int64, bool]:
        """Header and data offset of each complete frame; and whether frames are missing that the file claims."""
        headers: list[bytes] = []
        starts: list[int] = []
        position = self._file.tell()
        while len(headers) < claimed and position + _FRAME.size <= self._length:
            self._file.seek(position)
            header = self._file.read(_FRAME.size)
            if len(header) < _FRAME.size:
                break
            start = position + _FRAME.size
            colour, depth = _BYTES.unpack_from(header, 80)
            if start + colour + depth > self._length:
                break
            headers.append(header)
            starts.append(start)
            position = start + int(colour) + int(depth)
        fields = [("pose", "<f4", 16), ("time", "<u8"), ("depth_time", "<u8"), ("colour", "<i8"), ("depth", "<i8")]
        frames = np.frombuffer(b"".join(headers), np.dtype(fields))
        return frames, np.array(starts, np.int64), len(headers) < claimed
