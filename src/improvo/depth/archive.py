"""`depth.zip`: the depth maps of a run in one file.

A stored zip of 16-bit PNGs, `000123.png` for frame_index 123, and `depth.json` with their scales, unit and camera. Any
tool reads them once unzipped: depth = value / the scale of that frame, 0 is unknown. Depths are Z in the camera, in the
unit of the run. Each map has a scale of its own, so that one frame with a far view does not cost the others precision.
Files from before that have one `scale` for all maps, and are read too.
"""

from __future__ import annotations

import json
import zipfile
from contextlib import AbstractContextManager
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np

from improvo.errors import InputError
from improvo.files import written_atomically
from improvo.sequences.base import UnreadableFrameError
from improvo.sequences.images import decode
from improvo.types import Float32, Float64
from improvo.untrusted.arrays import FAULTS
from improvo.untrusted.text import load_json, reason

DEPTH_FILE = "depth.zip"
_ABOUT = "depth.json"
_LARGEST = 65535
_NEAR = 0.01  # this share of a map's depths is nearer than its near depth
_SPAN = 327.0  # farthest depth that is kept, by the near depth, which so has steps of half a per cent
_EPOCH = (1980, 1, 1, 0, 0, 0)  # the same maps give the same bytes


class DepthWriter:
    """`with DepthWriter(path, K) as maps: maps.write(frame, depth)`: the file appears at the end.

    Args:
        path: of the file.
        K: (3, 3) of the maps.
        unit: of the depths, for a person.
    """

    def __init__(self, path: Path, K: Float64, unit: str = "up to scale") -> None:
        self._atomic: AbstractContextManager[Path] = written_atomically(path)
        self._K, self._unit = K, unit
        self._frames: list[int] = []
        self._scales: list[float] = []

    def __enter__(self) -> DepthWriter:
        self._file = zipfile.ZipFile(self._atomic.__enter__(), "w")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                about = {
                    "unit": self._unit,
                    "depth": "value / scale of the frame, 0 where unknown; Z in the camera",
                    "K": self._K.tolist(),
                    "frames": self._frames,
                    "scales": self._scales,  # of each of the frames
                }
                self._store(_ABOUT, (json.dumps(about, indent=2) + "\n").encode())
            self._file.close()
        except BaseException as failure:
            self._atomic.__exit__(type(failure), failure, failure.__traceback__)
            raise
        self._atomic.__exit__(kind, error, trace)

    def write(self, frame_index: int, depth: Float32) -> None:
        """Add the map of a frame, (h, w) with 0 where unknown; what is 327 times as far as its near part is lost."""
        scale = _scale_of(depth)
        values = np.rint(depth.astype(np.float64) * scale)
        values = np.where((values >= 1) & (values <= _LARGEST), values, 0).astype(np.uint16)
        self._store(f"{frame_index:06d}.png", cv2.imencode(".png", values)[1].tobytes())
        self._frames.append(frame_index)
        self._scales.append(scale)

    def _store(self, name: str, content: bytes) -> None:
        self._file.writestr(zipfile.ZipInfo(name, _EPOCH), content)


def _scale_of(depth: Float32) -> float:
    """Values per unit of depth of a map."""
    known = depth[depth > 0].astype(np.float64)
    if len(known) == 0:
        return 1.0
    return float(_LARGEST / min(known.max(), _SPAN * np.quantile(known, _NEAR)))


class DepthReader:
    """Reads `depth.zip` back; a map is decoded when it is asked for.

    Args:
        path: the file, or the folder of the run.

    Raises:
        InputError: missing, damaged, or not written by improvo.
    """

    def __init__(self, path: Path) -> None:
        self.path = path / DEPTH_FILE if path.is_dir() else path
        about = self._about
        try:
            self.frames: list[int] = [int(frame) for frame in about["frames"]]  # frame_index of each map
            self.K: Float64 = np.array(about["K"], np.float64).reshape(3, 3)  # of the maps
            scales = about["scales"] if "scales" in about else [about["scale"]] * len(self.frames)
            self.scales = {frame: float(scale) for frame, scale in zip(self.frames, scales, strict=True)}
            if not (all(0 < scale < float("inf") for scale in self.scales.values()) and np.isfinite(self.K).all()):
                raise ValueError("numbers that cannot be")
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise self._damaged(error) from None

    @cached_property
    def _about(self) -> dict[str, Any]:
        content = self._read(_ABOUT)
        try:
            return dict(load_json(content.decode()))
        except (ValueError, TypeError) as error:
            raise self._damaged(error) from None

    def depth(self, frame_index: int) -> Float32:
        """(h, w) depth of a frame in the unit of the run, 0 where unknown.

        Raises:
            InputError: there is no map of this frame, or it is damaged.
        """
        if frame_index not in self.scales:
            raise InputError(f"{self.path}: has no depth of frame {frame_index}")
        try:
            values = decode(self._read(f"{frame_index:06d}.png"), cv2.IMREAD_UNCHANGED)
        except UnreadableFrameError as error:
            raise self._damaged(f"frame {frame_index}: {error}") from None
        if values.dtype != np.uint16 or values.ndim != 2:
            raise self._damaged(f"frame {frame_index} is no 16-bit PNG")
        return (values / self.scales[frame_index]).astype(np.float32)

    def _read(self, name: str) -> bytes:
        try:
            with zipfile.ZipFile(self.path) as file:
                return file.read(name)
        except FileNotFoundError:
            raise InputError(f"{self.path}: no such file; `improvo run --dense` writes it") from None
        except FAULTS as error:
            raise self._damaged(reason(error)) from None

    def _damaged(self, reason: object) -> InputError:
        return InputError(f"{self.path}: is damaged or not written by improvo ({reason}); run again with --dense")
