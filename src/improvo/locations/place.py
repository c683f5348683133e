"""One location and the local folder that stands for it: what is where, fetching, sending, and trying again."""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from improvo.errors import InputError, MissingExtraError, OutputError, imported

Answer = TypeVar("Answer")

STATE = "place.json"  # beside the folder: what of it is at the location
MARKER = ".improvo.json"  # of a folder that a command of ours has made
RECORD = "label.json"  # of a sequence of labels; it is sent last
_KEPT_HIDDEN = re.compile(re.escape(MARKER) + r"|\..+\.failed\.json")  # hidden files that belong to a folder's content
_LOCK = re.compile(r"\.[^/]+\.lock")
_WAITS = (0.5, 2.0, 8.0)  # seconds between tries
# What changes whenever a file is written anew, as file systems name it: S3, Azure, Google, SFTP, ..., in memory.
_VERSIONS = ("ETag", "etag", "md5Hash", "mtime", "LastModified", "last_modified", "updated", "modified", "created")
# On S3, the tries here are the only ones: botocore's and s3fs's own, one within the other, would take many minutes.
_S3 = {"retries": {"total_max_attempts": 1}, "connect_timeout": 10, "read_timeout": 30}


class LocationReadError(InputError):
    """A location cannot be read, after all tries; the next command on it goes on."""


class LocationWriteError(OutputError):
    """A location cannot be written to, after all tries; the next command on it goes on."""


class Place:
    """A location and the folder that stands for it."""

    def __init__(self, url: str, folder: Path, writing: bool) -> None:
        self.url, self.folder, self.writing = url, folder, writing
        self.listing: dict[str, int] = {}  # bytes of every file at the location, by its name in the folder
        self.locks: list[str] = []  # names of lock files at the location
        self._versions: dict[str, str] = {}  # of the files of the listing; empty where the location tells none
        # bytes and time of every local file that is the one at the location, and the version that it has there
        self._sent: dict[str, list[Any]] = {}
        self._process = -1
        self._away = False  # it did not answer last time: one try is enough to see whether it is back
        self._state = folder.parent / STATE

    @property
    def fs(self) -> Any:
        """The file system, of this process: connections do not survive a fork."""
        if self._process != os.getpid():
            fsspec = imported("fsspec", self.url, "remote")
            try:
                options: dict[str, Any] = {"skip_instance_cache": True} if self._process != -1 else {}
                on_s3 = self.url.startswith(("s3:", "s3a:"))
                if on_s3 and "config_kwargs" not in fsspec.config.conf.get("s3", {}):
                    options["config_kwargs"] = _S3
                self._fs, self._root = fsspec.core.url_to_fs(self.url, **options)
                if on_s3:
                    self._fs.retries = 1
            except (ImportError, ValueError) as error:
                reason = " ".join(str(error).split())
                raise InputError(f"{self.url}: cannot be reached ({reason}); `pip install s3fs` or its like") from None
            self._process = os.getpid()
        return self._fs

    def open(self) -> None:
        """Know what is there, and fetch it; of a label store only the records, its tables are fetched one by one."""
        with suppress(OSError, ValueError, TypeError, LookupError):
            self._sent = dict(json.loads(self._state.read_text(encoding="utf-8"))["sent"])
        found = self.tries(self._find, "read", LocationReadError)
        self.listing = {name: size for name, size in found.items() if name}
        for name in list(self._sent):
            path = self.folder / name
            if not self._is_sent(path) and path.exists():
                continue  # changed here and not sent
            if self._is_changed_there(name):
                if name != MARKER:  # whose the folder is stays true
                    path.unlink(missing_ok=True)
                del self._sent[name]
        one_by_one = {
            name.split("/")[0] for name in self.listing if name.count("/") == 1 and name.endswith(f"/{RECORD}")
        }
        for name in self.listing:
            folder, _, leaf = name.rpartition("/")
            if (folder not in one_by_one or leaf == RECORD) and not (self.folder / name).exists():
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

    def look(self, path: Path) -> None:
        """Know whether a file is there now."""
        target = self.remote(path)

        def ask() -> dict[str, Any] | None:
            self.fs.invalidate_cache()
            try:
                return dict(self.fs.info(target))
            except FileNotFoundError:
                return None

        found, name = self.tries(ask, "read", LocationReadError), self.name(path)
        if found is None:
            self.listing.pop(name, None)
        else:
            self.listing[name], self._versions[name] = int(found.get("size") or 0), _version(found)

    def fetch(self, path: Path) -> None:
        """Bring a file here, if it is there; it appears as a whole."""
        name = self.name(path)
        if name not in self.listing:
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.name}.{os.getpid()}-fetched.partial")
        try:
            self.tries(lambda: self.fs.get_file(self.remote(path), str(temporary)), "read", LocationReadError)
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

        self.tries(put, "written", LocationWriteError)
        self.listing[self.name(path)] = path.stat().st_size
        self._versions[self.name(path)] = self._version_of(target)
        self._note(path)
        self._remember()

    def give_up(self) -> None:
        """From now on, one try for each file."""
        self._away = True

    def send_all(self, folder: Path) -> None:
        """Bring all there that is complete; records of finished sequences last."""
        files = [path for path in sorted(folder.rglob("*")) if path.is_file() and not path.is_symlink()]
        chosen = [path for path in files if belongs(self.name(path))]
        for path in sorted(chosen, key=lambda path: path.name == RECORD):
            self.send(path)

    def drop(self, folder: Path) -> None:
        """Remove files that are there from here, all but the record."""
        for path in folder.rglob("*"):
            if path.is_file() and path.name != RECORD and self._is_sent(path):
                path.unlink()

    def remove(self, path: Path) -> None:
        """Remove a file, or all below a folder, from the location; the record first, then nothing counts."""
        name = self.name(path)
        gone = [other for other in self.listing if other == name or other.startswith(f"{name}/")]
        for other in sorted(gone, key=lambda other: not other.endswith(RECORD)):
            target = self.remote(self.folder / other)
            self.tries(partial(self.fs.rm_file, target), "written", LocationWriteError, missing=True)
            del self.listing[other]
            self._sent.pop(other, None)
        self._remember()

    def tries(
        self,
        action: Callable[[], Answer],
        what: str,
        kind: type[LocationReadError | LocationWriteError],
        missing: bool = False,
    ) -> Answer:
        """The answer of an action on the file system, which is tried again a few times.

        Args:
            action: what to do.
            what: "read" or "written", for the message.
            kind: of the error.
            missing: whether a file that is not there is no fault.
        """
        for wait in (*(() if self._away else _WAITS), None):
            try:
                answer = action()
                self._away = False
                return answer
            except (InputError, MissingExtraError):  # of the scheme
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
        self._away = not isinstance(fault, PermissionError | FileNotFoundError)
        reason = " ".join(str(fault).split())[:120] or type(fault).__name__
        end = f"what is done is kept in {self.folder.parent}; run again to go on" if what == "written" else "try again"
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
        entries = {full.removeprefix(root).lstrip("/"): entry for full, entry in found.items()}
        self.locks = [name for name in entries if _LOCK.fullmatch(name)]
        self._versions = {name: _version(entry) for name, entry in entries.items()}
        return {name: int(entry.get("size") or 0) for name, entry in entries.items() if name and belongs(name)}

    def _is_changed_there(self, name: str) -> bool:
        """Whether the location has another file now; networks of one architecture, for one, all have one size."""
        size, _, *versions = self._sent[name]
        if self.listing.get(name) != size:
            return True
        before, now = versions[0] if versions else "", self._versions.get(name, "")
        return bool(before and now) and before != now

    def _version_of(self, target: str) -> str:
        """Of a file that was just sent; empty where the location does not tell."""
        with suppress(Exception):
            self.fs.invalidate_cache()
            return _version(self.fs.info(target))
        return ""

    def _is_sent(self, path: Path) -> bool:
        try:
            state = path.stat()
        except OSError:
            return False
        return self._sent.get(self.name(path), [])[:2] == [state.st_size, state.st_mtime_ns]

    def _note(self, path: Path) -> None:
        state, name = path.stat(), self.name(path)
        self._sent[name] = [state.st_size, state.st_mtime_ns, self._versions.get(name, "")]

    def _remember(self) -> None:
        others: dict[str, list[Any]] = {}  # of other processes
        with suppress(OSError, ValueError, TypeError, LookupError):
            others = json.loads(self._state.read_text(encoding="utf-8"))["sent"]
        content = json.dumps({"url": self.url, "writing": self.writing, "sent": {**others, **self._sent}})
        temporary = self._state.with_suffix(f".{os.getpid()}")
        temporary.write_text(content, encoding="utf-8")
        os.replace(temporary, self._state)


def _version(entry: Mapping[str, Any]) -> str:
    """What tells a file from a later one of the same name and size; empty where the file system has nothing."""
    found = next((entry[name] for name in _VERSIONS if entry.get(name)), "")
    return str(found.timestamp() if isinstance(found, datetime) else found).strip('"')


def belongs(name: str) -> bool:
    """Whether a file is part of what a folder holds: nothing hidden, half-written, or made by training for itself."""
    parts = name.split("/")
    if ".." in parts or any(part.startswith(".") for part in parts[:-1]):
        return False
    leaf = parts[-1]
    if leaf.startswith("."):
        return _KEPT_HIDDEN.fullmatch(leaf) is not None
    return not leaf.startswith("landmarks-")
