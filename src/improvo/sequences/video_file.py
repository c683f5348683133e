"""A video file, through the FFmpeg inside OpenCV: time stamps as stored, rotation applied, decoded in order.

Opening reads the packets once without decoding them: their time stamps are the frames' times, also at a variable frame
rate. A decoded frame is recognised by its time stamp, never by counting, so a damaged frame cannot shift the others,
and a frame asked for out of order is the one that iteration gives. Calibration: `NAME.yaml` beside `NAME.mp4`, or
`camera.yaml` in its folder.
"""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np

from improvo.errors import InputError
from improvo.geometry.camera_files import folder_calibration
from improvo.sequences.base import Recording, SequenceSettings, UnreadableFrameError
from improvo.sequences.rates import DEFAULT_FPS
from improvo.sequences.video_codec import is_script, why_unreadable
from improvo.types import Int64, UInt8
from improvo.untrusted.paths import is_text

VIDEO_SUFFIXES = frozenset(
    {
        ".mp4",
        ".mov",
        ".avi",
        ".mkv",
        ".webm",
        ".m4v",
        ".mpg",
        ".mpeg",
        ".wmv",
        ".flv",
        ".3gp",
        ".mts",
        ".m2ts",
        ".ts",
        ".ogv",
    }
)
_UNDECODABLE = "the frame cannot be decoded"
_CHECKED = 8  # decoded frames whose stamps must agree with the packets'

# FFmpeg's own messages would drown the one line that says what to do
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


class VideoFile(Recording):
    """A video file that FFmpeg knows."""

    format = "video"

    def __init__(self, path: Path, settings: SequenceSettings) -> None:
        self.path = path
        self._capture: cv2.VideoCapture | None = None
        if not path.is_file():
            raise InputError(f"{path}: is no video file")
        if not is_text(path.absolute()):
            raise InputError(f"{path}: the name is no text, which the video decoder cannot open; rename it")
        if path.stat().st_size == 0:
            raise InputError(f"{path}: the file is empty; copy the video again")
        if is_script(path):
            raise InputError(f"{path}: is a text, not a video; if it names other files, give the videos themselves")
        self._position = -1  # frame that the decoder stands on
        self._image: UInt8 | None = None  # of `_position`, when it was asked for
        self._end: int | None = None  # where decoding turned out to end, before the last packet
        self._stamps, self._key_frames = _index(path)
        if len(self._stamps) == 0:
            raise InputError(f"{path}: {why_unreadable(path)}")
        count = len(self._stamps)
        self.times = self._stamps / 1e6 if settings.fps is None else np.arange(count) / settings.fps
        beside = tuple(f"{path.stem}{suffix}" for suffix in (".yaml", ".yml", ".json"))
        self.calibration = self.own_calibration(
            lambda: folder_calibration(path.parent, beside), lambda: folder_calibration(path.parent)
        )

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES

    def __del__(self) -> None:
        self._close()

    def source(self, index: int) -> str:
        return f"{self.path}#{index}"

    def image(self, index: int) -> UInt8:
        if self._end is not None and index >= self._end:
            raise UnreadableFrameError(_UNDECODABLE)
        if index < self._position or self._key_frame(index) > self._position + 1:
            self._seek(index)
        while self._position < index:
            before = self._position
            if not self._grab():
                self._end = before + 1
                raise UnreadableFrameError(_UNDECODABLE)
        if self._position > index:
            raise UnreadableFrameError(_UNDECODABLE)
        if self._image is None:
            decoded, image = self._opened().retrieve()
            if not decoded or image is None:
                raise UnreadableFrameError(_UNDECODABLE)
            self._image = np.asarray(image)
        return self._image

    def _seek(self, index: int) -> None:
        """Stand on or before the key frame of `index`, else at the start of the file."""
        key_frame = self._key_frame(index)
        if key_frame > 0:
            milliseconds = float(self._stamps[key_frame] - self._stamps[0]) / 1000.0
            if self._opened().set(cv2.CAP_PROP_POS_MSEC, milliseconds) and self._grab() and self._position <= key_frame:
                return
        self._close()

    def _grab(self) -> bool:
        """Decode the next frame; `_position` is then its number, found by its time stamp."""
        capture = self._opened()
        self._image = None
        if not capture.grab():
            self._close()
            return False
        if len(self._key_frames):
            self._position = int(np.abs(self._stamps - _stamp(capture)).argmin())
        else:
            self._position += 1
        return True

    def _key_frame(self, index: int) -> int:
        if len(self._key_frames) == 0:
            return 0
        return int(self._key_frames[np.searchsorted(self._key_frames, index, side="right") - 1])

    def _opened(self) -> cv2.VideoCapture:
        if self._capture is None:
            self._capture = cv2.VideoCapture(_name(self.path), cv2.CAP_FFMPEG)
            self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)
        return self._capture

    def _close(self) -> None:
        if self._capture is not None:
            self._capture.release()
        self._capture, self._position, self._image = None, -1, None


def _index(path: Path) -> tuple[Int64, Int64]:
    """Time stamps of all frames in microseconds, increasing, and which of them are key frames that can be sought.

    If the packets' stamps are not those of the decoded frames (AVI with B-frames, MPEG-1), the whole file is decoded
    once. Frames are then identified by counting, and there are no key frames.
    """
    packets = cv2.VideoCapture(_name(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
    stamps, is_key = [], []
    while packets.grab():
        stamps.append(_stamp(packets))
        is_key.append(packets.get(cv2.CAP_PROP_LRF_HAS_KEY_FRAME) > 0)
    packets.release()
    nothing = np.zeros(0, np.int64)
    if not stamps:
        return nothing, nothing
    opening = _decoded_stamps(path, _CHECKED)
    if not opening:
        return nothing, nothing
    increasing, first = np.unique(np.array(stamps, np.int64), return_index=True)
    if len(increasing) == len(stamps) and opening == increasing[:_CHECKED].tolist():
        keys = np.flatnonzero(np.array(is_key)[first])
        return increasing, np.union1d(keys, [0]).astype(np.int64)
    decoded = np.array(_decoded_stamps(path), np.int64)
    steps = np.diff(decoded)
    if (steps <= 0).any():
        step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1e6 / DEFAULT_FPS
        decoded = np.rint(np.arange(len(decoded)) * step).astype(np.int64)
    return decoded, nothing


def _name(path: Path) -> str:
    """The file for FFmpeg, which takes what stands before a colon in a relative name for a protocol."""
    return str(path.absolute())


def _decoded_stamps(path: Path, limit: int | None = None) -> list[int]:
    capture = cv2.VideoCapture(_name(path), cv2.CAP_FFMPEG)
    stamps: list[int] = []
    while (limit is None or len(stamps) < limit) and capture.grab():
        stamps.append(_stamp(capture))
    capture.release()
    return stamps


def _stamp(capture: cv2.VideoCapture) -> int:
    """Time stamp in microseconds, from the start of the file."""
    return round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1000.0)
