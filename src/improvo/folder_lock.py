"""One process at a time works in an output folder, or on a part of it: two would write the same files.

The lock belongs to a process, not to the file. However a process ends, it no longer holds the lock. The system's own
file locks say so at once. Where they do not reach (some shared file systems, between machines), a holder renews the
time of its lock file, and one whose file does not change any more is dead. A folder that stands for a location has such
a file there, too (`improvo.locations.claim`).
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from improvo import locations
from improvo.errors import ImprovoError, OutputError
from improvo.files import MARKER, make_output_folder, process_exists
from improvo.locations.claim import ClaimedError, holder_in

LOCK = ".improvo.lock"
_BEAT_SECONDS = 5.0
_PATIENCE_SECONDS = 75.0  # without a beat, after which a holder elsewhere is dead; NFS shows old times for a minute
_LONGEST = 1000  # bytes of a lock file
_SOMEBODY = "another process"
_WINDOWS = os.name == "nt"
_held: dict[Path, int] = {}  # lock file -> the thread of this process that holds it
_guard = threading.Lock()


class BusyError(OutputError):
    """Somebody else is at work there.

    Args:
        path: that is held.
        holder: who it is, in words.
    """

    def __init__(self, path: Path, holder: str) -> None:
        super().__init__(f"{path}: {holder} is at work there; wait until it ends, or choose another output folder")
        self.path, self.holder = path, holder

    def __reduce__(self) -> tuple[Any, ...]:  # pickle would give it the message alone
        return BusyError, (self.path, self.holder)


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Nobody else works in the folder within the block. A block within a block of the same folder is allowed.

    Args:
        folder: exists already.

    Raises:
        BusyError: another process or thread is at work there; the message says which, and since when.
    """
    with claimed(folder / LOCK, folder):
        locations.refresh(folder)  # what another machine has written to its location meanwhile
        yield


@contextmanager
def working_in(folder: Path, command: str) -> Iterator[None]:
    """Make an output folder, and be the only one to work there within the block.

    A folder that was not there before and in which nothing was written is removed where the block fails.

    Args:
        folder, command: see `make_output_folder`.

    Raises:
        OutputError: the folder cannot be used; a `BusyError` if another process is at work there.
    """
    new = not folder.exists()
    make_output_folder(folder, command)
    try:
        with locked(folder):
            yield
    except ImprovoError:
        if new and [path.name for path in folder.iterdir()] == [MARKER]:
            shutil.rmtree(folder)
        raise


@contextmanager
def claimed(file: Path, what: Path | None = None) -> Iterator[None]:
    """As `locked`, for anything that a lock file stands for.

    Args:
        file: of the lock; its folder exists already. It is there only while the lock is held.
        what: named in the message; the file if None.

    Raises:
        BusyError: another process or thread holds it.
        OutputError: the file cannot be written.
    """
    what = what or file
    place, thread = file.resolve(), threading.get_ident()
    with _guard:
        holder = _held.get(place)
        if holder is None:
            _held[place] = thread
    if holder == thread:
        yield
        return
    if holder is not None:
        raise BusyError(what, f"another thread of process {os.getpid()}")
    mine = _this_process()
    try:
        lock = _LockFile(file, what, mine)
        try:
            with _claimed_at_location(file, what, mine):
                yield
        finally:
            lock.release()
    finally:
        with _guard:
            del _held[place]


@contextmanager
def _claimed_at_location(file: Path, what: Path, mine: dict[str, Any]) -> Iterator[None]:
    """Where the file is of a folder that stands for a location, nobody else holds it there within the block."""
    try:
        claim = locations.take_claim(file, mine, _is_dead_here)
    except ClaimedError as error:
        raise BusyError(what, _words(error.holder)) from None
    try:
        yield
    finally:
        if claim is not None:
            claim.release()


class _LockFile:
    """A lock that this process holds, from its making to `release`."""

    def __init__(self, file: Path, what: Path, mine: dict[str, Any]) -> None:
        self._file, self._what, self._mine = file, what, mine
        self._released = threading.Event()
        try:
            self._descriptor = self._opened()
        except BlockingIOError:
            raise BusyError(what, holder_of(file) or _SOMEBODY) from None
        except OSError as error:
            raise OutputError(f"{file}: cannot be written ({error.strerror}); choose another folder") from None
        try:
            self._take()
        except BaseException:
            os.close(self._descriptor)
            raise
        threading.Thread(target=self._beat, daemon=True, name="lock").start()

    def release(self) -> None:
        """Let go; the file vanishes before somebody else can have it."""
        self._released.set()
        with suppress(OSError):
            if _WINDOWS:  # removes no open file: one that somebody else has opened stays, and names nobody
                os.ftruncate(self._descriptor, 0)
            else:
                os.unlink(self._file)
        with suppress(OSError):
            os.close(self._descriptor)
        if _WINDOWS:
            with suppress(OSError):
                os.unlink(self._file)

    def _opened(self) -> int:
        """The file, locked by the system where it can; never one that its holder has removed meanwhile."""
        while True:
            descriptor = os.open(self._file, os.O_RDWR | os.O_CREAT, 0o666)
            try:
                self._by_system = _lock(descriptor)
                with suppress(FileNotFoundError):
                    if os.path.samestat(os.fstat(descriptor), os.stat(self._file)):
                        return descriptor
            except BaseException:
                os.close(descriptor)
                raise
            os.close(descriptor)

    def _take(self) -> None:
        """Write who holds it, once whoever stands there is known to be gone."""
        before = self._content()
        if before and not self._is_gone(before):
            raise BusyError(self._what, _words(before))
        os.ftruncate(self._descriptor, 0)
        os.lseek(self._descriptor, 0, os.SEEK_SET)
        os.write(self._descriptor, json.dumps(self._mine).encode())
        if not self._by_system:  # two that begin at once both come here; the last one to write has it
            time.sleep(1.0)
            if (now := self._content()) != self._mine:
                raise BusyError(self._what, _words(now))

    def _content(self) -> dict[str, Any]:
        """What stands in the file. To open and close it once more would give the system's lock away."""
        return _holder_by(self._descriptor)

    def _is_gone(self, holder: dict[str, Any]) -> bool:
        """Whether the process that the file names is dead, or somewhere else, or on Windows, without a beat."""
        if holder.get("host") == socket.gethostname() and not _WINDOWS:  # which does not say what runs
            return self._by_system or not _is_running(holder.get("process"))
        ends = time.monotonic() + _PATIENCE_SECONDS
        beat = os.stat(self._file).st_mtime_ns
        while time.monotonic() < ends:
            time.sleep(_BEAT_SECONDS / 5)
            try:
                if os.stat(self._file).st_mtime_ns != beat:
                    return False
            except FileNotFoundError:  # it has let go just now; the next try will succeed
                return False
        return True

    def _beat(self) -> None:
        while not self._released.wait(_BEAT_SECONDS):
            with suppress(OSError):
                os.utime(self._file)


def seems_held(file: Path) -> bool:
    """Whether somebody holds a lock, said at once; a holder on another machine may have died since."""
    return _seems_held_here(file) or _seems_held_at_location(file)


def _seems_held_at_location(file: Path) -> bool:
    holder = locations.claimant(file)
    return holder is not None and not _is_dead_here(holder)


def _seems_held_here(file: Path) -> bool:
    if file.resolve() in _held:
        return True
    try:
        descriptor = os.open(file, os.O_RDWR)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    try:
        by_system = _lock(descriptor)
        holder = _holder_by(descriptor)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    if not holder:
        return False
    if holder.get("host") == socket.gethostname():
        return not by_system and _is_running(holder.get("process"))
    return True


def holder_of(file: Path) -> str:
    """Who a lock file of another process says holds it, in words; empty where it does not say."""
    try:
        with file.open("rb") as stream:
            found = holder_in(stream.read(_LONGEST))
    except OSError:
        found = locations.claimant(file) or {}
    return _words(found) if found else ""


def _holder_by(descriptor: int) -> dict[str, Any]:
    """Who stands in an open lock file."""
    os.lseek(descriptor, 0, os.SEEK_SET)  # Windows has no `os.pread`
    return holder_in(os.read(descriptor, _LONGEST))


def _lock(descriptor: int) -> bool:
    """Whether the system knows locks, and this process has it now.

    Raises:
        BlockingIOError: another process has it.
    """
    try:
        import fcntl
    except ImportError:  # not on Windows
        return False
    try:
        fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        raise BlockingIOError from None
    except OSError:  # a file system without locks
        return False
    return True


def _words(holder: dict[str, Any]) -> str:
    if not holder:
        return _SOMEBODY
    who = f"process {holder.get('process')} on {holder.get('host')}"
    return f"{who} (since {holder['since']})" if holder.get("since") else who


def _this_process() -> dict[str, Any]:
    """As a lock file names it."""
    since = time.strftime("%Y-%m-%d %H:%M:%S")
    return {"process": os.getpid(), "host": socket.gethostname(), "since": since, "token": os.urandom(8).hex()}


def _is_dead_here(holder: dict[str, Any]) -> bool:
    """Whether the holder was a process of this machine, and has ended."""
    return holder.get("host") == socket.gethostname() and not _is_running(holder.get("process"))


def _is_running(process: object) -> bool:
    """Whether the holder that a file names lives; what is no number cannot be asked for."""
    return not isinstance(process, int) or process_exists(process)
