"""Compressed bytes that may say little and hold much."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from improvo.untrusted.limits import MAX_CHUNK_BYTES, MAX_FILE_GROWTH, MIN_FILE_GROWTH


def decompress(make: Callable[[], Any], data: bytes, limit: int = MAX_CHUNK_BYTES) -> bytes:
    """All that the bytes decompress to, up to a limit.

    Args:
        make: a decompressor such as `bz2.BZ2Decompressor`, `zlib.decompressobj`, `lz4.frame.LZ4FrameDecompressor`.
        data: compressed, one stream after another.
        limit: bytes of the result.

    Raises:
        ValueError: it has more, or is cut short.
    """
    parts, total = [], 0
    while data:
        stream = make()
        parts.append(stream.decompress(data, limit + 1 - total))
        total += len(parts[-1])
        if total > limit:
            raise ValueError(f"it decompresses to more than {limit} bytes")
        if not stream.eof:
            raise ValueError("it is cut short")
        data = stream.unused_data or b""
    return b"".join(parts)


@contextmanager
def opened_with_limit(open_packed: Callable[..., Any], file: Any, mode: str = "rb") -> Iterator[Any]:
    """A packed file opened for reading, of which no more can be read than its size makes likely.

    Args:
        open_packed: such as `zstd.open`.
        file: the packed file, open.
        mode: of reading.
    """
    limit = max(MIN_FILE_GROWTH, MAX_FILE_GROWTH * os.fstat(file.fileno()).st_size)
    with open_packed(file, mode) as unpacked:
        yield _Limited(unpacked, limit)


class _Limited:
    """A readable file that ends with an error instead of going on beyond a limit."""

    def __init__(self, file: Any, limit: int) -> None:
        self._file, self._left, self._limit = file, limit, limit

    def read(self, size: int = -1) -> bytes:
        """The next bytes.

        Raises:
            ValueError: there are more than the limit.
        """
        content: bytes = self._file.read(min(size, self._left + 1) if size >= 0 else self._left + 1)
        self._left -= len(content)
        if self._left < 0:
            raise ValueError(f"it unpacks to more than {self._limit} bytes")
        return content
