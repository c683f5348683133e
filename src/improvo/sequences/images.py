"""Image files and encoded images: decoded whole, or refused."""

from __future__ import annotations

import os
import re
from pathlib import Path

import cv2
import numpy as np

from improvo.sequences.base import UnreadableFrameError
from improvo.types import Float32, UInt8

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm", ".pnm"})

# OpenCV's messages about damaged files would drown the one line that says what to do
if "OPENCV_LOG_LEVEL" not in os.environ:
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


def read_image(path: Path) -> UInt8:
    """(H, W) grey or (H, W, 3) BGR, 8 bits.

    Raises:
        UnreadableFrameError: missing, truncated, or not an image.
    """
    image = decode(_bytes(path), cv2.IMREAD_ANYCOLOR)
    return image.astype(np.uint8, copy=False)


def read_depth(path: Path, scale: float) -> Float32:
    """Depth in metres (H, W) from a 16-bit image: value / scale, NaN where it is 0 or 65535.

    Raises:
        UnreadableFrameError: missing, truncated, or not an image of one channel.
    """
    return depth_in_metres(decode(_bytes(path), cv2.IMREAD_UNCHANGED), scale)


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


def decode(data: bytes, flags: int) -> np.ndarray:
    """An encoded image.

    Raises:
        UnreadableFrameError: truncated, or no image that OpenCV knows. (OpenCV fills the rest of a truncated JPEG or
            PNG with grey, which would be tracked as if it had been seen.)
    """
    if not data:
        raise UnreadableFrameError("the file is empty")
    if _is_truncated(data):
        raise UnreadableFrameError("the image is truncated")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None or image.size == 0:
        raise UnreadableFrameError("not a readable image")
    return np.asarray(image)


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


def natural_key(name: str) -> list[tuple[int, str]]:
    """Sorts numbers in names by value."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name) if part]


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise UnreadableFrameError(error.strerror or str(error)) from None


def _is_truncated(data: bytes) -> bool:
    if data.startswith(b"\xff\xd8"):
        return data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")
    if data.startswith(b"\x89PNG"):
        return b"IEND" not in data[-64:]
    return False
