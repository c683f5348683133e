"""One process at a time works in an output folder: two would append to the same files.

The lock belongs to a process, not to the file. However a process ends, it no longer holds the lock.
"""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from improvo.errors import OutputError

LOCK = ".improvo.lock"
_held: dict[Path, int] = {}  # locked folder -> the thread of this process that holds it
_guard = threading.Lock()


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Nobody else works in the folder within the block. A block within a block of the same folder is allowed.

    Where the system or the file system knows no locks, the block runs without one.

    Args:
        folder: exists already.

    Raises:
        OutputError: another process or thread is at work there; the message says which.
    """
    place, thread = folder.resolve(), threading.get_ident()
    with _guard:
        holder = _held.get(place)
        if holder is None:
            _held[place] = thread
    if holder == thread:
        yield
        return
    if holder is not None:
        raise _busy(folder, f"another thread of process {os.getpid()}")
    try:
        with (folder / LOCK).open("a+") as stream:
            _lock(stream, folder)
            yield
            stream.truncate(0)
    finally:
        with _guard:
            del _held[place]


def _lock(stream: IO[str], folder: Path) -> None:
    try:
        import fcntl
    except ImportError:  # not on Windows
        return
    try:
        fcntl.lockf(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        stream.seek(0)
        raise _busy(folder, stream.read().strip() or "another process") from None
    except OSError:  # a file system without locks
        return
    stream.truncate(0)
    stream.write(f"process {os.getpid()} on {socket.gethostname()}")
    stream.flush()


def _busy(folder: Path, who: str) -> OutputError:
    return OutputError(f"{folder}: {who} is at work there; wait until it ends, or choose another output folder")
