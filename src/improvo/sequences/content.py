"""What is in a recording, for results that are kept: under the same path there may be another one by now."""

from __future__ import annotations

import hashlib
from pathlib import Path

from improvo.errors import InputError
from improvo.sequences.base import Recording, UnreadableFrameError

_SAMPLE = 1 << 20  # bytes at the beginning, in the middle and at the end of a file
_DIGEST_BYTES = 16
_DEPTH_MAPS = 16  # pairs of neighbours that are decoded


def content_of(recording: Recording) -> str:
    """A digest of a recording, hexadecimal, the same wherever it lies; a look at it, not all of its bytes.

    Of a file its size and three samples, among which a video has the places of all its frames. Of a folder, and of a
    file that lists pictures, its times, the names and sizes of all pictures, and three of them as decoded.
    """
    digest = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    looked_at = sorted({0, len(recording) // 2, len(recording) - 1} if len(recording) else ())
    if recording.path.is_file():
        _add_file(digest, recording.path)
        if not any(Path(recording.source(index)).is_file() for index in looked_at):
            return digest.hexdigest()
    digest.update(recording.times.tobytes())
    for index in range(len(recording)):
        file = Path(recording.source(index))
        if file.is_file():
            digest.update(f"{file.name}\0{file.stat().st_size}\0".encode("utf-8", "surrogateescape"))
    for index in looked_at:
        try:
            picture = recording.image(index)
        except (InputError, UnreadableFrameError):  # this frame is damaged or missing
            continue
        digest.update(str(picture.shape).encode() + picture.tobytes())
    return digest.hexdigest()


def depth_content(recording: Recording) -> str:
    """A digest of a recording's depth, hexadecimal, by some of its maps evenly spread over all frames.

    It is no part of `content_of`, since features, tracks and labels do not depend on it, as true measures do.
    """
    digest = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    for index in range(0, len(recording), max(len(recording) // _DEPTH_MAPS, 1)):
        for neighbour in (index, index + 1):  # some recordings have depth for every second frame
            if neighbour < len(recording):
                digest.update(_depth_bytes(recording, neighbour))
    return digest.hexdigest()


def _depth_bytes(recording: Recording, index: int) -> bytes:
    try:
        depth = recording.depth(index)
    except (InputError, UnreadableFrameError):  # this map is damaged or missing
        depth = None
    return b"none" if depth is None else str(depth.shape).encode() + depth.tobytes()


def _add_file(digest: hashlib.blake2b, path: Path) -> None:
    size = path.stat().st_size
    digest.update(str(size).encode())
    with path.open("rb") as file:
        for start in sorted({0, max(size // 2 - _SAMPLE // 2, 0), max(size - _SAMPLE, 0)}):
            file.seek(start)
            digest.update(file.read(_SAMPLE))
