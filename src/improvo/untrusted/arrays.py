"""NumPy's archives: shapes are compared with the bytes that are there before an array is made."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable, Iterable
from math import prod
from pathlib import Path
from tokenize import TokenError
from typing import IO, Any

import numpy as np

from improvo.untrusted.limits import MAX_ARRAY_BYTES
from improvo.untrusted.text import reason

FAULTS: tuple[type[Exception], ...] = (  # what reading a damaged archive may raise
    *(OSError, ValueError, LookupError, TypeError, AttributeError, EOFError, MemoryError, OverflowError),
    *(RuntimeError, SyntaxError, TokenError, zipfile.BadZipFile, zlib.error),
)


def check_array(name: str, shape: Iterable[int], item_bytes: int, limit: int = MAX_ARRAY_BYTES) -> int:
    """Bytes of an array of this shape.

    Raises:
        ValueError: more than are read.
    """
    count = prod(int(side) for side in shape) * int(item_bytes)
    if not 0 <= count <= limit:
        raise ValueError(f"`{name}` says that it has {count} bytes, more than {limit}")
    return count


def read_npz(path: Path, wanted: Callable[[str], bool] = lambda name: True, limit: int = MAX_ARRAY_BYTES) -> Any:
    """The arrays of an NPZ file by name; nothing is unpickled.

    Args:
        path: of the file.
        wanted: which names to read.
        limit: bytes of one array.

    Raises:
        ValueError: no such archive, damaged, or an array of more bytes than are there.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            arrays = {}
            for name, info in members.items():
                if wanted(name):
                    with archive.open(info) as stream:
                        arrays[name] = _read_npy(name, stream, info.file_size, limit)
            return arrays
    except FAULTS as error:
        raise ValueError(reason(error)) from None


def _read_npy(name: str, stream: IO[bytes], size: int, limit: int) -> Any:
    version = np.lib.format.read_magic(stream)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"`{name}` has NumPy's format {version}, which is not read")
    shape, by_columns, dtype = readers[version](stream)
    if dtype.hasobject:
        raise ValueError(f"`{name}` holds Python objects")
    count = check_array(name, shape, dtype.itemsize, limit)
    if count > size:
        raise ValueError(f"`{name}` says that it has {count} bytes, and has {size}")
    content = stream.read(count)
    if len(content) != count:
        raise ValueError(f"`{name}` is cut short")
    array = np.frombuffer(content, dtype) if count else np.zeros(prod(shape), dtype)
    return array.reshape(shape, order="F" if by_columns else "C").copy()
