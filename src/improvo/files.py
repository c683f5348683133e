"""Output that is never half-written, and output folders that are ours."""

from __future__ import annotations

import hashlib
import json
import os
import re
import secrets
import shutil
import socket
import sys
import time
import weakref
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from improvo import locations
from improvo.errors import InputError, OutputError
from improvo.formats import FORMAT, FORMAT_KEY, check_format
from improvo.locations.place import MARKER as MARKER  # of a folder that a command of ours has made
from improvo.untrusted.paths import check_is_file, check_path, is_text
from improvo.untrusted.text import load_json

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

FORMER_NAME = "sivo"  # of this package; folders and weights written under it stay readable
_TEMPORARY = re.compile(r"\..+\.(\d+)(?:-(\w+))?\.partial(?:\..*)?", re.DOTALL)  # see `temporary_name`
_HOST = hashlib.sha256(socket.gethostname().encode()).hexdigest()[:6]
_FOREIGN_SECONDS = 86400.0  # after which a temporary file of another machine is of a process that ended
_LONGEST_NAME = 100  # bytes of a name that go into that of its temporary file; systems take 255 in all
_open_here: set[str] = set()  # names of temporary files and folders that this process is writing
_sources: weakref.WeakKeyDictionary[object, Path] = weakref.WeakKeyDictionary()  # reader -> the file that it reads


def never_replace(path: Path, reader: object) -> None:
    """No output may replace this file as long as `reader` is there: nobody has a second copy of a recording."""
    _sources[reader] = path.absolute()


def is_same_file(one: Path, other: Path) -> bool:
    """Whether both are there, and the same."""
    try:
        return one.samefile(other)
    except (OSError, ValueError):
        return False


def content_hash(path: Path) -> str:
    """SHA-256 of what is in a file, hexadecimal: by it weights are known whatever they are called."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


@contextmanager
def written_atomically(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` to write to; it replaces `path` when the block ends, and vanishes if it fails.

    The folder is made where it is missing, so that nothing needs to be made before there is something to write.
    """
    if any(is_same_file(path, source) for source in list(_sources.values())):
        raise OutputError(f"{path}: is being read, and the output would replace it; choose another name")
    temporary = path.with_name(temporary_name(path.name, path.suffix))
    made = False
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # a new file, never what lies or is linked there under this name
        os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0), 0o666))
        made = True
        _open_here.add(temporary.name)
        yield temporary
        os.replace(temporary, path)
        made = False
        locations.written(path)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror or error}); choose another folder") from None
    finally:
        _open_here.discard(temporary.name)
        if made:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)


def temporary_name(name: str, suffix: str = "") -> str:
    """A hidden name for what is not complete; nobody can guess it, and `clear_leftovers` knows whose it was.

    .NAME.PROCESS-MACHINE+CHANCE.partial.SUFFIX
    """
    short = os.fsencode(name)[:_LONGEST_NAME].decode(errors="ignore") or "_"
    return f".{short}.{os.getpid()}-{_HOST}{secrets.token_hex(4)}.partial{suffix[:20]}"


def clear_leftovers(folder: Path) -> None:
    """Remove what killed processes left half-written in a folder of ours, and below it."""
    for place, folders, names in os.walk(folder):
        for name in [*names, *folders]:
            _remove_leftover(Path(place) / name)


def _remove_leftover(path: Path) -> None:
    """Remove a temporary file or folder, unless its process may still write it."""
    if _TEMPORARY.fullmatch(path.name) is None or is_being_written(path):
        return
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink(missing_ok=True)


def is_being_written(path: Path) -> bool:
    """Whether this is a temporary file or folder, and the process that made it may still write it."""
    match = _TEMPORARY.fullmatch(path.name)
    if match is None:
        return False
    process, token = int(match.group(1)[:9]), match.group(2) or ""
    if len(token) == len(_HOST) + 8 and not token.startswith(_HOST):  # of another machine, on a shared file system
        try:
            return abs(time.time() - path.lstat().st_mtime) < _FOREIGN_SECONDS  # also where a clock was set back
        except OSError:
            return True
    another = process != os.getpid() and os.name == "posix"
    return path.name in _open_here or (another and process_exists(process))


def process_exists(process: int) -> bool:
    """Whether a process of this machine has this number; True where that cannot be told."""
    if os.name != "posix":
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with written_atomically(path) as temporary:
        # names of files may hold bytes that are no text
        temporary.write_text(text, encoding="utf-8", errors="surrogateescape")


def write_json(path: Path, data: Any) -> None:
    """Write JSON atomically, indented, with NaN refused (use None)."""
    write_text(path, json.dumps(data, indent=2, allow_nan=False) + "\n")


def write_png(path: Path, rgb: NDArray[np.uint8]) -> None:
    """Write a picture (H, W, 3) RGB."""
    import numpy as np

    write_picture(path, np.ascontiguousarray(rgb[..., ::-1]))


def write_picture(path: Path, image: NDArray[np.uint8]) -> None:
    """Write a picture (H, W) grey or (H, W, 3) BGR in the format of its suffix; the name may be bytes that are no text.

    (OpenCV 5 ends the process when it is given such a name.)
    """
    import cv2

    with written_atomically(path) as temporary:
        try:
            encoded, data = cv2.imencode(path.suffix, image)
        except cv2.error:  # no such format
            encoded = False
        if not encoded:
            raise OutputError(f"{path}: pictures cannot be written as '{path.suffix}'; name it .png or .jpg")
        temporary.write_bytes(data.tobytes())


def check_output_folder(path: Path, command: str) -> None:
    """Refuse a folder that `command` did not make, before any work is done.

    Raises:
        OutputError: the path is a file, a folder with other content or of a later improvo, or cannot be written.
    """
    _check_name(path)
    if path.exists() and not path.is_dir():
        raise OutputError(f"{path}: is a file, not a folder; choose another output folder")
    try:
        check_folder_format(path)
    except InputError as error:
        raise OutputError(str(error)) from None
    if path.is_dir() and any(not _is_temporary(entry) for entry in path.iterdir()):
        owner = _owner(path)
        if owner != command:
            made_by = f"was made by `improvo {owner}`" if owner else "has files that improvo did not write"
            raise OutputError(f"{path}: exists and {made_by}; choose an empty or new output folder")
    if path.is_symlink() and not path.exists():
        raise OutputError(f"{path}: is a link to what is not there; choose another output folder")
    existing = next(parent for parent in (path, *path.absolute().parents) if parent.exists())
    if not existing.is_dir():
        raise OutputError(f"{path}: {existing} is a file, not a folder; choose another output folder")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise OutputError(f"{path}: no permission to write in {existing}; choose another output folder")


def check_output_file(path: Path, suffixes: Collection[str] = (), beside: str = "") -> None:
    """Refuse a file that cannot be written, before any work is done; clear what killed processes left beside it.

    Args:
        path: of the file.
        suffixes: of files of its kind, with their dots. What exists under another is not replaced.
        beside: suffix of a second file that is written with it. One that is there without the first is another's.

    Raises:
        OutputError: it is a folder, lies in a file, has an impossible name, is of another kind, or there is no
            permission.
    """
    _check_name(path)
    if path.is_dir():
        raise OutputError(f"{path}: is a folder; give the name of a file in it")
    if suffixes and path.exists() and path.suffix.lower() not in suffixes:
        raise OutputError(f"{path}: exists, and is no {' or '.join(suffixes)} file to be replaced; choose another name")
    if beside and path.with_suffix(beside).exists() and not path.exists():
        raise OutputError(f"{path.with_suffix(beside)}: exists, and would be replaced, too; choose another name")
    existing = next(parent for parent in path.absolute().parents if parent.exists())
    if not existing.is_dir():
        raise OutputError(f"{path}: {existing} is a file, not a folder; choose another folder")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise OutputError(f"{path}: no permission to write in {existing}; choose another folder")
    if path.parent.is_dir():
        for left in path.parent.glob(".*.partial*"):  # the folder is the user's, and may be large: nothing below it
            _remove_leftover(left)


def _check_name(path: Path) -> None:
    try:
        check_path(path, reachable=True)
    except InputError as error:
        raise OutputError(str(error)) from None
    if not is_text(path):  # tables and networks are written by libraries that take nothing else
        raise OutputError(f"{path}: the name is no text here (encoding {sys.getfilesystemencoding()}); choose another")


def make_output_folder(path: Path, command: str) -> None:
    """Create the folder and mark it as made by `command` (checked first, see `check_output_folder`)."""
    check_output_folder(path, command)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{path}: cannot be created ({error.strerror}); choose another output folder") from None
    write_json(path / MARKER, {"made_by": command, FORMAT_KEY: FORMAT})
    clear_leftovers(path)


def remove_unused_folder(path: Path) -> None:
    """Remove an output folder that holds its marker and empty folders alone, since its command did nothing."""
    if any(file.is_file() and file != path / MARKER for file in path.rglob("*")):
        return
    with suppress(OSError):
        shutil.rmtree(path)


def _is_temporary(path: Path) -> bool:
    """Whether `written_atomically` left this, in a process that was killed; it may have been the first file of all."""
    return path.name.startswith(".") and ".partial" in path.suffixes


def check_folder_format(path: Path) -> None:
    """Refuse a folder that a later improvo made.

    Raises:
        InputError: see `formats.check_format`.
    """
    check_format(_marker(path).get(FORMAT_KEY), path)


def _owner(path: Path) -> str | None:
    """The command that made a folder; None where no marker says so."""
    owner = _marker(path).get("made_by")
    return owner if isinstance(owner, str) else None


def _marker(path: Path) -> dict[str, Any]:
    """What the marker of a folder says; empty where there is none."""
    for name in (MARKER, f".{FORMER_NAME}.json"):
        try:
            marker = load_json(check_is_file(path / name).read_text(encoding="utf-8"))
        except (InputError, OSError, ValueError):
            continue
        if isinstance(marker, dict):
            return marker
    return {}
