"""The sizes that encoded pictures name, read from their headers before any decoder believes them."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from itertools import islice

from improvo.untrusted.limits import MAX_PICTURE_BYTES, MAX_PIXELS

Size = tuple[int, int, int]  # width, height, bytes a pixel when decoded

_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}
_NO_FRAME = {0xC4, 0xC8, 0xCC}  # among JPEG's 0xC0 to 0xCF: tables, not the start of a frame
_ALONE = {0x01, *range(0xD0, 0xD9)}  # JPEG markers without a length
_PNM = re.compile(rb"P[1-6](?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s")
_TIFF_TYPES = {1: "B", 3: "H", 4: "I", 16: "Q"}
_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_BITS, _TIFF_SAMPLES, _TILE_WIDTH, _TILE_HEIGHT = 256, 257, 258, 277, 322, 323


def check_picture(data: bytes) -> None:
    """Refuse a picture that says it is larger than we read, or whose kind we cannot tell.

    Raises:
        ValueError: it is.
    """
    try:
        sizes = list(_sizes(data))
    except (struct.error, IndexError, OverflowError):  # the last where it points beyond all memory
        raise ValueError("the image is truncated") from None
    if not sizes:
        raise ValueError("not a readable image")
    for width, height, pixel_bytes in sizes:
        if width < 1 or height < 1:
            raise ValueError(f"says that it has {width}x{height} pixels")
        if width * height > MAX_PIXELS or width * height * pixel_bytes > MAX_PICTURE_BYTES:
            raise ValueError(f"says that it has {width}x{height} pixels, too many")


def _sizes(data: bytes) -> Iterator[Size]:
    """Every size that the first picture names."""
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        yield from _png(data)
    elif data.startswith(b"\xff\xd8"):
        yield from _jpeg(data)
    elif data[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        yield from _tiff(data)
    elif data.startswith(b"BM"):
        width, height = struct.unpack_from("<ii", data, 18) if data[14] != 12 else struct.unpack_from("<HH", data, 18)
        yield abs(width), abs(height), 4
    elif data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        yield from _webp(data)
    elif data.startswith((b"\0\0\0\x0cjP  \r\n\x87\n", b"\xff\x4f\xff\x51")):
        yield from _jpeg2000(data)
    elif match := _PNM.match(data):
        yield int(match.group(1)), int(match.group(2)), 6


def _png(data: bytes) -> Iterator[Size]:
    """Of every header, and of every frame of an animated one."""
    position = 8
    while position + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, position)
        if position == 8 and kind != b"IHDR":
            raise ValueError("not a readable image")
        if kind == b"IHDR":
            width, height, depth, colour = struct.unpack_from(">IIBB", data, position + 8)
            yield width, height, _PNG_CHANNELS.get(colour, 4) * max(depth // 8, 1)
        elif kind == b"fcTL":
            _, width, height = struct.unpack_from(">III", data, position + 8)
            yield width, height, 8
        elif kind == b"IEND":
            return
        position += 12 + length


def _jpeg(data: bytes) -> Iterator[Size]:
    position = 2
    while position + 4 <= len(data):
        if data[position] != 0xFF:
            return
        marker = data[position + 1]
        if marker == 0xFF or marker in _ALONE:
            position += 1 if marker == 0xFF else 2
            continue
        if 0xC0 <= marker <= 0xCF and marker not in _NO_FRAME:
            height, width, components = struct.unpack_from(">HHB", data, position + 5)
            yield width, height, max(components, 3)
        if marker in (0xD9, 0xDA):
            return
        position += 2 + struct.unpack_from(">H", data, position + 2)[0]


def _tiff(data: bytes) -> Iterator[Size]:
    """Of the first page: the picture, and its tiles."""
    order = "<" if data.startswith(b"II") else ">"
    big = data[2:4] in (b"+\0", b"\0+")
    (directory,) = struct.unpack_from(f"{order}{'Q' if big else 'I'}", data, 8 if big else 4)
    (count,) = struct.unpack_from(f"{order}{'Q' if big else 'H'}", data, directory)
    entry, value_at = (20, 12) if big else (12, 8)
    start = directory + (8 if big else 2)
    found: dict[int, int] = {}
    for number in islice(range(count), 4096):
        place = start + entry * number
        tag, kind = struct.unpack_from(f"{order}HH", data, place)
        (values,) = struct.unpack_from(f"{order}{'Q' if big else 'I'}", data, place + 4)
        if kind in _TIFF_TYPES and tag in (256, 257, 258, 277, 322, 323):
            letter = _TIFF_TYPES[kind]
            inline = values * struct.calcsize(letter) <= (8 if big else 4)
            at = place + value_at
            if not inline:
                (at,) = struct.unpack_from(f"{order}{'Q' if big else 'I'}", data, at)
            (found[tag],) = struct.unpack_from(f"{order}{letter}", data, at)
    samples = max(found.get(_TIFF_SAMPLES, 1), 1)
    pixel_bytes = max(samples, 3) * max(found.get(_TIFF_BITS, 8) // 8, 1)
    yield found.get(_TIFF_WIDTH, 0), found.get(_TIFF_HEIGHT, 0), pixel_bytes
    if _TILE_WIDTH in found or _TILE_HEIGHT in found:
        yield found.get(_TILE_WIDTH, 0), found.get(_TILE_HEIGHT, 0), pixel_bytes


def _webp(data: bytes) -> Iterator[Size]:
    kind = data[12:16]
    if kind == b"VP8X":
        yield 1 + int.from_bytes(data[24:27], "little"), 1 + int.from_bytes(data[27:30], "little"), 4
    elif kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        yield 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF), 4
    elif kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, 26)
        yield width & 0x3FFF, height & 0x3FFF, 4


def _jpeg2000(data: bytes) -> Iterator[Size]:
    """Of the codestream, and of the header of its file."""
    box = data.find(b"ihdr", 0, 4096)
    if box >= 0:
        height, width, components = struct.unpack_from(">IIH", data, box + 4)
        yield width, height, 2 * max(components, 3)
    stream = data.find(b"\xff\x4f\xff\x51")
    if stream >= 0:
        right, bottom, left, top = struct.unpack_from(">4I", data, stream + 8)
        tile_width, tile_height = struct.unpack_from(">2I", data, stream + 24)
        yield right - left, bottom - top, 8
        if tile_width < 1 or tile_height < 1 or (right * bottom) // (tile_width * tile_height) > MAX_PIXELS >> 8:
            raise ValueError("says that it has too many tiles")
