"""The image files of one recording, all read in the same way: the same grey levels and the same EXIF rotation."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from improvo.errors import InputError
from improvo.sequences.base import Recording, UnreadableFrameError
from improvo.sequences.grey_levels import SAMPLES, Stretch, stretch_of, to_8_bits
from improvo.sequences.images import decode, file_bytes
from improvo.types import UInt8
from improvo.untrusted.paths import check_is_file, is_file, is_text

_HEAD = 1 << 16  # bytes in which a JPEG's orientation stands
_FLAGS = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH
_PLAIN = 1  # the orientation of a picture that is stored as it is seen


class ImageFiles:
    """Files by their number. `notes` say what was done to their grey levels and orientation.

    An EXIF rotation that all pictures share (a phone held upright) is applied. If it changes within a recording, none
    is applied, because the calibration holds for the unrotated pictures. Files that are missing or empty say nothing.
    """

    def __init__(self, files: Iterable[Path], where: Path) -> None:
        self.files = list(files)
        self.notes: list[str] = []
        self._flags = _FLAGS
        noted = [orientation(file) for file in self.files if _has_content(file)]
        turned = sum(value != _PLAIN for value in noted)
        if turned and len(set(noted)) > 1:
            self._flags |= cv2.IMREAD_IGNORE_ORIENTATION
            self.notes.append(
                f"{where}: {turned} of {len(noted)} pictures note another rotation (EXIF) than the others; all are "
                "read as the sensor made them"
            )
        pages = self._pages()
        if pages > 1:
            self.notes.append(
                f"{where}: {self.files[0].name} holds {pages} pages, and only the first is read; split it"
            )
        self._stretch = self._common_stretch()
        if self._stretch is not None:
            self.notes.append(f"{where}: {self._stretch.note}")

    def __len__(self) -> int:
        return len(self.files)

    def present(self) -> NDArray[np.bool_]:
        """(N,) whether each file is there; none is read."""
        return np.array([is_file(file) for file in self.files], np.bool_)

    def read(self, index: int) -> UInt8:
        """(H, W) grey or (H, W, 3) BGR, 8 bits.

        Raises:
            UnreadableFrameError: missing, truncated, or not an image.
        """
        return to_8_bits(self._decoded(index), self._stretch)

    def _decoded(self, index: int) -> np.ndarray:
        return decode(file_bytes(self.files[index]), self._flags)

    def _pages(self) -> int:
        """How many pictures the first file holds, if it is a TIFF."""
        if not self.files or self.files[0].suffix.lower() not in (".tif", ".tiff") or not self.files[0].is_file():
            return 1
        return int(cv2.imcount(str(self.files[0]))) if is_text(self.files[0]) else 1

    def _common_stretch(self) -> Stretch | None:
        first = next((row for row, file in enumerate(self.files[:SAMPLES]) if _may_be_deep(file)), None)
        if first is None:
            return None
        rows = np.unique(np.linspace(first, len(self.files) - 1, min(SAMPLES, len(self.files) - first)).astype(int))
        pictures = []
        for row in rows.tolist():
            try:
                pictures.append(self._decoded(row))
            except UnreadableFrameError:
                continue
            if pictures[-1].dtype == np.uint8:
                return None
        return stretch_of(pictures)


class ImageFilesRecording(Recording):
    """A recording with a file for each picture; its constructor sets `_images`."""

    _images: ImageFiles

    def source(self, index: int) -> str:
        return str(self._images.files[index])

    def image(self, index: int) -> UInt8:
        return self._images.read(index)

    def present(self) -> NDArray[np.bool_]:
        return self._images.present()


def _has_content(path: Path) -> bool:
    try:
        return path.stat().st_size > 0
    except (OSError, ValueError):
        return False


def orientation(path: Path) -> int:
    """The EXIF orientation that a JPEG file notes, 1 to 8; 1 without one."""
    if path.suffix.lower() not in (".jpg", ".jpeg", ".jpe", ".jfif"):
        return _PLAIN
    try:
        with check_is_file(path).open("rb") as file:
            head = file.read(_HEAD)
    except (InputError, OSError):
        return _PLAIN
    start = head.find(b"Exif\0\0")
    if not head.startswith(b"\xff\xd8") or start < 0:
        return _PLAIN
    tiff = head[start + 6 :]
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None:
        return _PLAIN
    try:
        (directory,) = struct.unpack_from(f"{order}I", tiff, 4)
        (count,) = struct.unpack_from(f"{order}H", tiff, directory)
        for entry in range(count):
            tag, _, _, value = struct.unpack_from(f"{order}HHIH", tiff, directory + 2 + 12 * entry)
            if tag == 0x0112:
                return value if 1 <= value <= 8 else _PLAIN
    except struct.error:
        return _PLAIN
    return _PLAIN


def _may_be_deep(path: Path) -> bool:
    """Whether a file may hold more than 8 bits, by its first bytes; not decoded."""
    suffix = path.suffix.lower()
    if suffix in (".tif", ".tiff", ".jp2"):
        return True
    try:
        with check_is_file(path).open("rb") as file:
            head = file.read(64)
    except (InputError, OSError, ValueError):  # a name that no system knows: reading it will say so
        return False
    if head.startswith(b"\x89PNG"):
        return len(head) > 24 and head[24] == 16
    match = re.match(rb"P[2356]\s+(?:#[^\n]*\n\s*)*\d+\s+\d+\s+(\d+)", head)
    return match is not None and int(match.group(1)) > 255
