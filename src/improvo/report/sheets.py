"""Pictures of frames as PNG files, as one sheet, or as a video."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from improvo.errors import OutputError
from improvo.files import write_png, written_atomically
from improvo.report.canvas import stacked
from improvo.types import UInt8
from improvo.untrusted.paths import is_text

# Codecs that OpenCV's wheels can write into MP4: VP9 plays in browsers, MPEG-4 is the fallback.
_CODECS = ("vp09", "mp4v")


def write_sheet(path: Path, pictures: Sequence[UInt8], columns: int | None = None) -> None:
    """Write pictures of one size as one PNG, in as many columns as make the sheet about as wide as high."""
    height, width = pictures[0].shape[:2]
    best = round(float(np.sqrt(len(pictures) * 1.5 * height / width)))
    write_png(path, stacked(list(pictures), columns or max(1, best)))


def write_video(path: Path, pictures: Iterable[UInt8], fps: float) -> None:
    """Write pictures of one size as an MP4.

    Raises:
        OutputError: the file cannot be written.
    """
    pictures = iter(pictures)
    first = next(pictures)
    height, width = (side - side % 2 for side in first.shape[:2])  # codecs want even sides
    with written_atomically(path) as temporary:
        writer = _writer(temporary, max(fps, 1.0), width, height)
        if writer is None:
            raise OutputError(f"{path}: OpenCV cannot write a video here; leave out --video to get PNG files")
        try:
            for rgb in _chain(first, pictures):
                writer.write(np.ascontiguousarray(rgb[:height, :width, ::-1]))
        finally:
            writer.release()


def _writer(path: Path, fps: float, width: int, height: int) -> cv2.VideoWriter | None:  # type: ignore[name-defined] # noqa: F821
    import cv2

    if not is_text(path):  # OpenCV ends the process
        return None
    # OpenCV's own warning that a codec is not usual in MP4 would only worry people
    log = getattr(cv2.utils, "logging", None)
    level = log.getLogLevel() if log else None
    if log:
        log.setLogLevel(log.LOG_LEVEL_SILENT)
    try:
        for codec in _CODECS:
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), fps, (width, height))
            if writer.isOpened():
                return writer
    finally:
        if log:
            log.setLogLevel(level)
    return None


def _chain(first: UInt8, rest: Iterator[UInt8]) -> Iterator[UInt8]:
    yield first
    yield from rest
