"""Folders anywhere: on S3, Google Cloud Storage and all that fsspec reaches, each with a local folder in its stead.

A command gets the local folder and works there as in any other. What is read is fetched when it is first asked for
(`fetched`); what is complete is sent at once (`written`, called by `improvo.files`) or as a whole (`publish`). Label
tables and packed frames are fetched one by one, all else when the location is opened. Nobody else may write to a
location meanwhile, except that several commands may label into one.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from improvo.errors import InputError, MissingExtraError, OutputError

Answer = TypeVar("Answer")

_SCHEME = re.compile(r"([a-z][a-z0-9+.-]*)://(.+)", re.DOTALL)
_STATE, _FILES = "place.json", "files"  # in a folder for each location
_KEPT_HIDDEN = re.compile(r"\.improvo\.json|\..+\.failed\.json")  # hidden files that belong to a folder's content
_RECORD = "label.json"  # beside it, everything is fetched one by one; it is sent last
_WAITS = (0.5, 2.0, 8.0)  # seconds between tries
_places: dict[Path, _Place] = {}


def is_remote(text: str) -> bool:
    """Whether this names a location, and not a file or folder of this machine."""
    match = _SCHEME.fullmatch(text)
    return match is not None and match.group(1) != "file"


def local_folder(text: str | Path, writing: bool = True) -> Path:
    """The folder to work in: the path itself, or one that stands for a location.

    Args:
        text: a path, `file://...`, or `s3://bucket/folder`.
        writing: whether what is written there is sent to the location.

    Raises:
        MissingExtraError: fsspec is not installed.
        InputError: the location cannot be reached.
    """
    match = _SCHEME.fullmatch(str(text))
    if match is None:
        return Path(text)
    if match.group(1) == "file":
        return Path("/" + match.group(2).lstrip("/"))
    url = str(text).rstrip("/")
    folder = _cache() / hashlib.sha256(url.encode()).hexdigest()[:16] / _FILES
    folder.mkdir(parents=True, exist_ok=True)
    place = _Place(url, folder, writing)
    place.open()
    _places[folder] = place
    return folder


def url_of(folder: Path) -> str:
    """The location that a folder of `local_folder` stands for; empty for any other folder."""
    place = _place_of(folder)
    return place.url if place is not None and place.folder == folder.absolute() else ""


def folder_here(folder: Path, url: str) -> Path:
    """A folder that another process gave, or one of this machine for the same location, if that is another machine."""
    return local_folder(url) if url and url_of(folder) != url else folder


def refresh(folder: Path) -> None:
    """Look again what a location has; others may have written to it.

    Raises:
        InputError: it cannot be read.
    """
    place = _place_of(folder)
    if place is not None:
        place.open()


def with_urls(text: str) -> str:
    """A text for a person: locations in place of the folders that stand for them."""
    for folder, place in _places.items():
        text = text.replace(str(folder), place.url)
    return text


def fetched(path: Path) -> Path:
    """The path, whose file is here now if its location has it.

    Raises:
        InputError: it cannot be fetched.
    """
    if not path.exists() and (place := _place_of(path)) is not None:
        place.fetch(path)
    return path


def size_of(path: Path) -> int:
    """Bytes of a file that is here or at its location.

    Raises:
        FileNotFoundError: it is neither.
    """
    place = _place_of(path)
    if place is not None and not path.exists():
        found = place.listing.get(place.name(path))
        if found is not None:
            return found
    return path.stat().st_size


def opened(path: Path) -> Any:
    """A local path, or an open file of the location that reads only what is asked for.

    Raises:
        InputError: it cannot be opened.
    """
    place = None if path.exists() else _place_of(path)
    if place is None or place.name(path) not in place.listing:
        return path
    target = place.remote(path)
    return place.tries(lambda: place.fs.open(target, "rb", block_size=1 << 20), "read", InputError)


def exists(path: Path) -> bool:
    """Whether a file is here or at its location."""
    if path.exists():
        return True
    place = _place_of(path)
    return place is not None and place.name(path) in place.listing


def written(path: Path) -> None:
    """A file is complete: it is sent, if it stands for one of a location, and no part of what is not complete.

    Raises:
        OutputError: it cannot be sent.
    """
    place = _place_of(path)
    if place is not None and place.writing and _belongs(place.name(path)):
        place.send(path)


def publish(folder: Path) -> None:
    """A folder is complete: send what of it was not sent, what says that it is complete last.

    A finished sequence of a label store that is a location as a whole does not stay here: a disk may not hold them all.

    Raises:
        OutputError: it cannot be sent.
    """
    place = _place_of(folder)
    if place is not None and place.writing:
        place.send_all(folder)
        if folder.absolute().parent == place.folder and (folder / _RECORD).is_file():
            place.drop(folder)


def removed(folder: Path) -> None:
    """A folder, or file, was removed or renamed here: it is removed from its location too.

    Raises:
        OutputError: it cannot be removed.
    """
    place = _place_of(folder)
    if place is not None and place.writing:
        place.remove(folder)


def close(success: bool = True) -> None:
    """At the end of a command: send what was not sent.

    Args:
        success: of the command; after a failure, what cannot be sent is left for the next start.

    Raises:
        OutputError: it cannot be sent.
    """
    try:
        for place in list(_places.values()):
            if place.writing:
                place.send_all(place.folder)
    except OutputError:
        if success:
            raise


class _Place:
    """A location and the folder that stands for it."""

    def __init__(self, url: str, folder: Path, writing: bool) -> None:
        self.url, self.folder, self.writing = url, folder, writing
        self.listing: dict[str, int] = {}  # bytes of every file at the location, by its name in the folder
        self._sent: dict[str, list[int]] = {}  # bytes and time of every local file that is the one at the location
        self._process = -1
        self._state = folder.parent / _STATE

    @property
    def fs(self) -> Any:
        """The file system, of this process: connections do not survive a fork."""
        if self._process != os.getpid():
            try:
                import fsspec
            except ImportError:
                raise MissingExtraError(f"{self.url}", "remote") from None
            try:
                new = {"skip_instance_cache": True} if self._process != -1 else {}
                self._fs, self._root = fsspec.core.url_to_fs(self.url, **new)
            except (ImportError, ValueError) as error:
                reason = " ".join(str(error).split())
                raise InputError(f"{self.url}: cannot be reached ({reason}); `pip install s3fs` or its like") from None
            self._process = os.getpid()
        return self._fs

    def open(self) -> None:
        """Know what is there, and fetch all that is not fetched one by one."""
        with suppress(OSError, ValueError, TypeError):
            self._sent = dict(json.loads(self._state.read_text())["sent"])
        found = self.tries(self._find, "read", InputError)
        self.listing = {name: size for name, size in found.items() if name}
        for name, (size, _) in list(self._sent.items()):
            path = self.folder / name
            if not self._is_sent(path) and path.exists():
                continue  # changed here and not sent
            if self.listing.get(name) != size:  # changed there
                path.unlink(missing_ok=True)
                del self._sent[name]
        one_by_one = {name.rpartition("/")[0] for name in self.listing if name.rpartition("/")[2] == _RECORD}
        for name in self.listing:
            folder, _, leaf = name.rpartition("/")
            if (folder not in one_by_one or leaf == _RECORD) and not (self.folder / name).exists():
                self.fetch(self.folder / name)
        self._remember()

    def name(self, path: Path) -> str:
        """Of a file within the folder."""
        return path.absolute().relative_to(self.folder).as_posix()

    def remote(self, path: Path) -> str:
        """Of a file, for the file system."""
        _ = self.fs
        name = self.name(path)
        return str(self._root if name == "." else f"{self._root.rstrip('/')}/{name}")

    def fetch(self, path: Path) -> None:
        """Bring a file here, if it is there; it appears as a whole."""
        name = self.name(path)
        if name not in self.listing:
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.name}.{os.getpid()}-fetched.partial")
        try:
            self.tries(lambda: self.fs.get_file(self.remote(path), str(temporary)), "read", InputError)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
        self._note(path)

    def send(self, path: Path) -> None:
        """Bring a file there."""
        if self._is_sent(path):
            return
        target = self.remote(path)

        def put() -> None:
            parent = target.rpartition("/")[0]
            with suppress(OSError, NotImplementedError):  # object stores have no folders
                self.fs.makedirs(parent, exist_ok=True)
            self.fs.put_file(str(path), target)

        self.tries(put, "written", OutputError)
        self.listing[self.name(path)] = path.stat().st_size
        self._note(path)
        self._remember()

    def send_all(self, folder: Path) -> None:
        """Bring all there that is complete; records of finished sequences last."""
        files = [path for path in sorted(folder.rglob("*")) if path.is_file() and not path.is_symlink()]
        chosen = [path for path in files if _belongs(self.name(path))]
        for path in sorted(chosen, key=lambda path: path.name == _RECORD):
            self.send(path)

    def drop(self, folder: Path) -> None:
        """Remove files that are there from here, all but the record."""
        for path in folder.rglob("*"):
            if path.is_file() and path.name != _RECORD and self._is_sent(path):
                path.unlink()

    def remove(self, path: Path) -> None:
        """Remove a file, or all below a folder, from the location; the record first, then nothing counts."""
        name = self.name(path)
        gone = [other for other in self.listing if other == name or other.startswith(f"{name}/")]
        for other in sorted(gone, key=lambda other: not other.endswith(_RECORD)):
            target = self.remote(self.folder / other)
            self.tries(partial(self.fs.rm_file, target), "written", OutputError, missing=True)
            del self.listing[other]
            self._sent.pop(other, None)
        self._remember()

    def tries(
        self, action: Callable[[], Answer], what: str, kind: type[InputError | OutputError], missing: bool = False
    ) -> Answer:
        """The answer of an action on the file system, which is tried again a few times.

        Args:
            action: what to do.
            what: "read" or "written", for the message.
            kind: of the error.
            missing: whether a file that is not there is no fault.
        """
        for wait in (*_WAITS, None):
            try:
                return action()
            except (InputError, MissingExtraError):
                raise
            except FileNotFoundError as error:
                if missing:
                    return None  # type: ignore[return-value]
                fault: Exception = error
            except Exception as error:  # every file system has its own
                fault = error
            if wait is None or isinstance(fault, PermissionError | FileNotFoundError):
                break
            time.sleep(wait)
        reason = " ".join(str(fault).split())[:120] or type(fault).__name__
        end = f"what is done is kept in {self.folder}; run again to go on" if what == "written" else "try again"
        raise kind(f"{self.url}: cannot be {what} ({reason}); {end}") from None

    def _find(self) -> dict[str, int]:
        """Bytes of every file, by its name in the folder; nothing where nothing is there."""
        fs = self.fs
        fs.invalidate_cache()
        root = self._root.rstrip("/")
        try:
            found = fs.find(root, detail=True)
        except FileNotFoundError:
            return {}
        return {
            name: int(entry.get("size") or 0)
            for full, entry in found.items()
            if (name := full.removeprefix(root).lstrip("/")) and _belongs(name)
        }

    def _is_sent(self, path: Path) -> bool:
        try:
            state = path.stat()
        except OSError:
            return False
        return self._sent.get(self.name(path)) == [state.st_size, state.st_mtime_ns]

    def _note(self, path: Path) -> None:
        state = path.stat()
        self._sent[self.name(path)] = [state.st_size, state.st_mtime_ns]

    def _remember(self) -> None:
        others: dict[str, list[int]] = {}  # of other processes
        with suppress(OSError, ValueError, TypeError, LookupError):
            others = json.loads(self._state.read_text())["sent"]
        content = json.dumps({"url": self.url, "writing": self.writing, "sent": {**others, **self._sent}})
        temporary = self._state.with_suffix(f".{os.getpid()}")
        temporary.write_text(content)
        os.replace(temporary, self._state)


def _belongs(name: str) -> bool:
    """Whether a file is part of what a folder holds: nothing hidden, half-written, or made by training for itself."""
    parts = name.split("/")
    if ".." in parts or any(part.startswith(".") for part in parts[:-1]):
        return False
    leaf = parts[-1]
    if leaf.startswith("."):
        return _KEPT_HIDDEN.fullmatch(leaf) is not None
    return not leaf.startswith("landmarks-")


def _place_of(path: Path) -> _Place | None:
    """The location that a path belongs to; also in a process that got the path from another."""
    path = path.absolute()
    cache = _cache()
    if cache not in path.parents:
        return None
    folder = cache / path.relative_to(cache).parts[0] / _FILES
    if folder not in _places:
        try:
            state = json.loads((folder.parent / _STATE).read_text())
            place = _Place(str(state["url"]), folder, bool(state["writing"]))
        except (OSError, ValueError, LookupError, TypeError):
            return None
        place.open()
        _places[folder] = place
    return _places[folder]


def _cache() -> Path:
    given = os.environ.get("IMPROVO_CACHE") or os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    try:
        root = Path(given or Path.home() / ".cache")
    except RuntimeError:  # a user without a home
        root = Path(tempfile.gettempdir())
    return root.absolute() / "improvo" / "places"
