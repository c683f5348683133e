"""Pictures of frames as PNG files, as one sheet, or as a video."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from improvo.errors import OutputError
from improvo.files import write_png, written_atomically
from improvo.report.canvas import stacked
from improvo.types import UInt8
from improvo.untrusted.paths import is_text

# What OpenCV's wheels can write, by the suffix of the file. MPEG-4 takes a millisecond for a picture of 540x360 where
# VP8 takes thirty and VP9 a hundred, but browsers play only those two.
_CODECS = {".mp4": ("mp4v", "vp09"), ".webm": ("VP80", "vp09")}
_ANIMATIONS = (".gif", ".webp")  # by Pillow; for a page or a README
_SLOWEST, _FASTEST = 0.5, 1000.0  # pictures a second; what is slower, WebM cannot hold
_FASTEST_GIF = 50.0  # browsers show a picture of less than two hundredths of a second for ten of them
MOVING = (*_CODECS, *_ANIMATIONS)


def write_sheet(path: Path, pictures: Sequence[UInt8], columns: int | None = None) -> None:
    """Write pictures of one size as one PNG, in as many columns as make the sheet about as wide as high."""
    height, width = pictures[0].shape[:2]
    best = round(float(np.sqrt(len(pictures) * 1.5 * height / width)))
    write_png(path, stacked(list(pictures), columns or max(1, best)))


def write_video(path: Path, pictures: Iterable[UInt8], fps: float, width: int | None = None) -> None:
    """Write pictures of one size as a moving one: MP4 (MPEG-4), WebM (VP8), or an animated GIF or WebP.

    Args:
        path: its suffix, one of `MOVING`, says which.
        pictures: RGB, at least one.
        fps: pictures a second, kept between 0.5 and 1000. A GIF, whose pictures stay for hundredths of a second and no
            shorter than two, gets as many of them as it can show.
        width: pixels, to make them smaller; None keeps their size.

    Raises:
        OutputError: the file cannot be written.
    """
    pictures = (_resized(picture, width) for picture in pictures)
    fps = min(max(fps, _SLOWEST), _FASTEST)
    if path.suffix.lower() in _ANIMATIONS:
        _write_animation(path, pictures, fps)
        return
    first = next(pictures)
    height, width = (side - side % 2 for side in first.shape[:2])  # codecs want even sides
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # its messages would drown the one line that says what to do
    with written_atomically(path) as temporary, _without_messages():
        writer = _writer(temporary, _CODECS.get(path.suffix.lower(), ()), fps, width, height)
        if writer is None:
            raise OutputError(f"{path}: OpenCV cannot write such a video here; try .mp4, or a folder for PNG files")
        try:
            written = 0
            for rgb in _chain(first, pictures):
                writer.write(np.ascontiguousarray(rgb[:height, :width, ::-1]))
                written += 1
        finally:
            writer.release()
        if _frames_in(temporary) < written:  # OpenCV does not say so
            raise OutputError(f"{path}: cannot be written (is the disk full?); choose another folder")


def _resized(picture: UInt8, width: int | None) -> UInt8:
    if width is None or width >= picture.shape[1]:
        return picture
    import cv2

    height = round(picture.shape[0] * width / picture.shape[1])
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _write_animation(path: Path, pictures: Iterator[UInt8], fps: float) -> None:
    """All pictures are in memory at once: these formats are for short ones."""
    from PIL import Image

    is_gif = path.suffix.lower() == ".gif"
    every = math.ceil(round(fps / _FASTEST_GIF, 6)) if is_gif else 1
    first, *others = (Image.fromarray(picture) for picture in islice(pictures, 0, None, every))
    unit = 10 if is_gif else 1  # milliseconds
    ends = [unit * round(number * every * 1000 / fps / unit) for number in range(len(others) + 2)]
    durations = [end - begin for begin, end in pairwise(ends)]
    more: dict[str, Any] = {} if is_gif else {"quality": 60, "method": 4}
    with written_atomically(path) as temporary:
        first.save(temporary, save_all=True, append_images=others, duration=durations, loop=0, **more)


def _writer(path: Path, codecs: tuple[str, ...], fps: float, width: int, height: int) -> cv2.VideoWriter | None:  # type: ignore[name-defined] # noqa: F821
    import cv2

    if not is_text(path):  # OpenCV ends the process
        return None
    for codec in codecs:
        with _nothing_on_stderr():
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), fps, (width, height))
        if writer.isOpened():
            return writer
    return None


@contextmanager
def _without_messages() -> Iterator[None]:
    """OpenCV's own, that a codec is not usual in MP4 or that a frame could not be written, would only worry people."""
    import cv2

    log = getattr(cv2.utils, "logging", None)
    level = log.getLogLevel() if log else None
    if log:
        log.setLogLevel(log.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        if log:
            log.setLogLevel(level)


@contextmanager
def _nothing_on_stderr() -> Iterator[None]:
    """OpenCV says past its own log, to the process's stderr, that WebM knows no names of codecs."""
    try:
        before = os.dup(2)
    except OSError:  # closed
        yield
        return
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        if sys.stderr is not None:
            sys.stderr.flush()
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(before, 2)
        os.close(before)
        os.close(nowhere)


def _frames_in(path: Path) -> int:
    """How many frames are in a video, by its packets, which are not decoded."""
    import cv2

    packets = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])
    count = 0
    while packets.grab():
        count += 1
    packets.release()
    return count


def _chain(first: UInt8, rest: Iterator[UInt8]) -> Iterator[UInt8]:
    yield first
    yield from rest
