"""Encoded images: decoded completely, or refused."""

from __future__ import annotations

import io
import os
import re
from pathlib import Path

import cv2
import numpy as np

from improvo.errors import InputError
from improvo.sequences.base import UnreadableFrameError
from improvo.sequences.grey_levels import to_8_bits
from improvo.types import Float32, UInt8
from improvo.untrusted.limits import MAX_PICTURE_BYTES
from improvo.untrusted.paths import check_is_file, is_file
from improvo.untrusted.pictures import check_picture
from improvo.untrusted.text import reason

IMAGE_SUFFIXES = frozenset(
    {".png", ".jpg", ".jpeg", ".jpe", ".jfif", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm", ".pnm", ".jp2"}
)
_END_OF_JPEG = b"\xff\xd9"
_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")  # in the coded data of a JPEG: neither stuffing nor a restart

# OpenCV's messages about damaged files would drown the one line that says what to do
if "OPENCV_LOG_LEVEL" not in os.environ:
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


def read_image(path: Path) -> UInt8:
    """(H, W) grey or (H, W, 3) BGR, 8 bits: of deeper images the upper eight.

    Raises:
        UnreadableFrameError: missing, truncated, or not an image.
    """
    return to_8_bits(decode(file_bytes(path), cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH))


def read_grey(path: Path) -> UInt8:
    """(H, W) grey, 8 bits.

    Raises:
        UnreadableFrameError: missing, truncated, or not an image.
    """
    return np.asarray(decode(file_bytes(path), cv2.IMREAD_GRAYSCALE), np.uint8)


def read_depth(path: Path, scale: float) -> Float32:
    """Depth in metres (H, W) from a 16-bit image: value / scale, NaN where it is 0 or 65535.

    Raises:
        UnreadableFrameError: missing, truncated, or not an image of one channel.
    """
    return depth_in_metres(decode(file_bytes(path), cv2.IMREAD_UNCHANGED), scale)


def depth_in_metres(values: np.ndarray, scale: float) -> Float32:
    """Raw depth values (H, W) / scale, NaN where missing: 0, 65535, negative or not finite."""
    if values.ndim != 2:
        raise UnreadableFrameError(f"depth has {values.ndim} dimensions, not 2")
    metres = values.astype(np.float32) / np.float32(scale)
    missing = ~(metres > 0) | ~np.isfinite(metres)
    if values.dtype == np.uint16:
        missing |= values == 65535
    metres[missing] = np.nan
    return metres


def depth_of_size(depth: Float32, size: tuple[int, int] | None) -> Float32:
    """Depth (h, w) of a view as depth (H, W) of the same view in `size` (W, H): each pixel looks up the nearest.

    It stays as it is where that is its size, or where that is None.
    """
    if size is None or depth.shape == (size[1], size[0]):
        return depth
    return np.asarray(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST_EXACT))


def decode(data: bytes, flags: int) -> np.ndarray:
    """An encoded image. What follows its end (the video of a motion photo, say) is left out.

    Raises:
        UnreadableFrameError: truncated, or no image that OpenCV knows. (OpenCV fills the rest of a truncated JPEG or
            PNG with grey, which would be tracked as if it had been seen.)
    """
    if not data:
        raise UnreadableFrameError("the file is empty")
    try:
        check_picture(data)
    except ValueError as error:
        raise UnreadableFrameError(str(error)) from None
    if data.startswith(b"\xff\xd8"):
        return _decode_jpeg(data, flags)
    if data.startswith(b"\x89PNG"):
        end = _end_of_png(data)
        if end is None:
            raise UnreadableFrameError("the image is truncated")
        data = data[:end]
    return _decoded(data, flags)


def _decode_jpeg(data: bytes, flags: int) -> np.ndarray:
    end = _end_of_jpeg(data)
    if end is not None:
        return _decoded(data[:end], flags)
    if data.endswith(b"\0" * 16):  # a file that was made at full size and never filled
        data = data.rstrip(b"\0")
    if not _is_whole(data):
        raise UnreadableFrameError("the image is truncated")
    return _decoded(data + _END_OF_JPEG, flags)


def _is_whole(data: bytes) -> bool:
    """Whether a JPEG without an end marker holds all of its picture: nothing that could follow changes it.

    Decoded by Pillow, which is silent about damage where OpenCV's decoder writes to the terminal.
    """
    from PIL import Image

    seen = set()
    try:
        for more in (b"", b"\x00" * 64, b"\xa5\x5a" * 32):
            with Image.open(io.BytesIO(data + more + _END_OF_JPEG)) as image:
                seen.add(hash(image.tobytes()))
    except Exception:  # Pillow raises errors of many kinds, from OSError to SyntaxError
        return False
    return len(seen) == 1


def _decoded(data: bytes, flags: int) -> np.ndarray:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except (cv2.error, MemoryError):
        image = None
    if image is None or image.size == 0:
        raise UnreadableFrameError("not a readable image")
    return np.asarray(image)


def _end_of_jpeg(data: bytes) -> int | None:
    """Where the first image of a JPEG file ends, None where its end marker is missing."""
    position = 2
    while position + 4 <= len(data):
        if data[position] != 0xFF:
            return None
        marker = data[position + 1]
        if marker == 0xFF:  # padding before a marker
            position += 1
            continue
        if marker == 0xD9:
            return position + 2
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
        if marker == 0xDA:
            found = _MARKER.search(data, position)
            if found is None:
                return None
            position = found.start()
            if data[position + 1] == 0xD9:
                return position + 2
    return len(data) if data[position : position + 2] == _END_OF_JPEG else None


def _end_of_png(data: bytes) -> int | None:
    position = 8
    while position + 12 <= len(data):
        kind = data[position + 4 : position + 8]
        position += 12 + int.from_bytes(data[position : position + 4], "big")
        if kind == b"IEND":
            return position if position <= len(data) else None
    return None


def grey(image: UInt8) -> UInt8:
    """(H, W) from grey, BGR or BGRA."""
    if image.ndim == 2:
        return image
    if image.shape[2] == 1:
        return image[..., 0]
    code = cv2.COLOR_BGRA2GRAY if image.shape[2] == 4 else cv2.COLOR_BGR2GRAY
    return np.asarray(cv2.cvtColor(image, code))


def list_images(folder: Path) -> list[Path]:
    """The image files of a folder in natural order (2 before 10), hidden ones left out."""
    files = [p for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".")]
    return sorted(files, key=lambda path: natural_key(path.name))


def listed_file(folder: Path, name: str) -> Path:
    """The file that a list in `folder` names, also with Windows' separators or with the path of another machine."""
    name = name.strip().strip("\"'")
    plain = name.replace("\\", "/")
    parts = [part for part in plain.split("/") if part not in ("", ".")]
    tails = ["/".join(parts[-count:]) for count in (len(parts), 3, 2, 1) if 0 < count <= len(parts)]
    candidates = [folder / name, folder / plain, *(folder / tail for tail in tails)]
    return next((file for file in candidates if is_file(file)), folder / plain)


def natural_key(name: str) -> list[tuple[int, str]]:
    """Sorts numbers in names by value, however long they are; 07 before 7, in whatever order a folder lists them."""
    parts = [part for part in re.split(r"(\d+)", name) if part]
    digits = [part.lstrip("0") if part.isdecimal() else "" for part in parts]
    by_value = [(len(n), n) if part.isdecimal() else (-1, part) for part, n in zip(parts, digits, strict=True)]
    return [*by_value, (-2, name)]


def file_bytes(path: Path) -> bytes:
    """The content of a file.

    Raises:
        UnreadableFrameError: it cannot be read.
    """
    try:
        check_is_file(path)
    except InputError:
        raise UnreadableFrameError("is a pipe or a device, not a file") from None
    try:
        if path.stat().st_size > MAX_PICTURE_BYTES:
            raise UnreadableFrameError("the file is too large for a picture")
        return path.read_bytes()
    except (OSError, ValueError, MemoryError) as error:
        raise UnreadableFrameError(reason(error)) from None
