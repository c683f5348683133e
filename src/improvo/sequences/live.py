"""Webcams (`0`, `1`, ...) and network streams (`rtsp://`, `http://`, ...), live: always the latest frame.

A thread keeps the newest frame; frames that the reader was too slow for are dropped and counted. A live recording has
no length, no random access and no ground truth.
"""

from __future__ import annotations

import os
import re
import threading
import time
from pathlib import Path

import cv2
import numpy as np

from improvo.errors import InputError
from improvo.sequences.base import Recording, SequenceSettings, UnreadableFrameError
from improvo.types import UInt8
from improvo.untrusted.paths import is_text

OPEN_TIMEOUT = 10.0  # seconds until a stream counts as unreachable
FRAME_TIMEOUT = 5.0  # seconds without a frame until the source counts as gone
_ADDRESS = re.compile(r"(rtsps?|rtmps?|https?|udp|tcp|srt)://.+", re.IGNORECASE)


def is_live(path: str) -> bool:
    """Whether this is the number of a webcam or the address of a stream, and no file of that name.

    Args:
        path: as given, or a `Path` of it as text, which on Windows has backslashes.
    """
    if _ADDRESS.fullmatch(path) or _address(path) is not None:
        return True
    return re.fullmatch(r"\d{1,3}", path) is not None and not Path(path).exists()


class LiveStream(Recording):
    """A webcam or stream, opened; `close` ends its thread."""

    format = "live"

    def __init__(self, path: Path, settings: SequenceSettings) -> None:
        self.path = path
        self._name = _address(str(path)) or str(path)
        if not is_live(str(path)):
            raise InputError(f"{path}: is neither a webcam number nor a stream's address")
        self._capture = _open(self._name)
        self.times = np.zeros(0)
        self.dropped = 0  # frames that came while the last one was still worked on
        self._arrivals = 0  # frames that came
        self._latest: tuple[int, float, UInt8] | None = None
        self._ended = False
        self._arrived = threading.Condition()
        self._thread = threading.Thread(target=self._watch, name=f"improvo {self._name}", daemon=True)
        self._thread.start()

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return is_live(str(path))

    def source(self, index: int) -> str:
        return f"{self._name}#{index}"

    def image(self, index: int) -> UInt8:
        raise UnreadableFrameError("a live stream has no random access")

    def next_frame(self) -> tuple[int, float, UInt8] | None:
        """The newest frame not yet delivered, after its number and its seconds since 1970, waiting for it.

        None when the source is gone.
        """
        with self._arrived:
            self._arrived.wait_for(lambda: self._latest is not None or self._ended, FRAME_TIMEOUT)
            latest, self._latest = self._latest, None
        return latest

    def close(self) -> None:
        """End the thread and let go of the device."""
        with self._arrived:
            self._ended = True
            self._arrived.notify_all()
        if self._thread is not threading.current_thread():
            self._thread.join(FRAME_TIMEOUT)

    def _watch(self) -> None:
        began = time.time() - time.perf_counter()  # a clock that is set meanwhile would let a time come twice
        while not self._ended:
            read, image = self._capture.read()
            now = began + time.perf_counter()
            with self._arrived:
                if not read or image is None:
                    self._ended = True
                else:
                    self.dropped += self._latest is not None
                    self._latest = (self._arrivals, now, np.asarray(image))
                    self._arrivals += 1
                self._arrived.notify_all()
        self._capture.release()


def _address(path: str) -> str | None:
    """The stream's address; a `Path` turns `rtsp://` into `rtsp:/`, on Windows with backslashes."""
    match = re.fullmatch(r"((?:rtsps?|rtmps?|https?|udp|tcp|srt):)(/+|\\+)([^/\\].*)", path, re.IGNORECASE)
    if match is None:
        return None
    scheme, separator, rest = match.groups()
    return f"{scheme}//{rest if separator[0] == '/' else rest.replace(separator[0], '/')}"


def _open(name: str) -> cv2.VideoCapture:
    if not is_text(Path(name)):
        raise InputError(f"{name!r}: is no address")
    if name.isdigit():
        capture = cv2.VideoCapture(int(name))
        mend = "is it plugged in, and not used by another program?"
    else:
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        limits = [
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
            int(1000 * OPEN_TIMEOUT),
            cv2.CAP_PROP_READ_TIMEOUT_MSEC,
            int(1000 * FRAME_TIMEOUT),
        ]
        capture = cv2.VideoCapture(name, cv2.CAP_FFMPEG, limits)
        mend = "is the address right, and the network up?"
    if not capture.isOpened():
        what = "webcam" if name.isdigit() else "stream"
        raise InputError(f"{name}: the {what} cannot be opened; {mend}")
    return capture
