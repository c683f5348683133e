"""Compressed bytes that may say little and hold much."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from improvo.untrusted.limits import MAX_CHUNK_BYTES


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
