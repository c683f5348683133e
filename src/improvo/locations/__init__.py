"""Folders anywhere: on S3, Google Cloud Storage and all that fsspec reaches, each with a local folder in its stead.

It imports no other room. Open this file first, then `place.py`; `claim.py` is about two at once.

A command gets the local folder and works there as in any other. What is read is fetched when it is first asked for
(`fetched`); what is complete is sent at once (`written`, called by `improvo.files`) or as a whole (`publish`). Label
tables and packed frames are fetched one by one, all else when the location is opened. Who works there says so in a
lock file at the location, see `improvo.folder_lock`; several commands may label into one.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import tempfile
from pathlib import Path
from typing import Any

from improvo.errors import OutputError
from improvo.locations.claim import Claim, IsDead, read_claim
from improvo.locations.place import RECORD, STATE, LocationReadError, LocationWriteError, Place, belongs

LOCATION_ERRORS = (LocationReadError, LocationWriteError)
_SCHEME = re.compile(r"([a-z][a-z0-9+.-]*)://(.+)", re.DOTALL)
_FILES = "files"  # in a folder for each location
_places: dict[Path, Place] = {}


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
    place = Place(url, folder, writing)
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


def looked_up(path: Path) -> Path:
    """The path, whose file is here now if its location has it by now; others may have written it.

    Raises:
        InputError: it cannot be fetched.
    """
    place = _place_of(path)
    if place is not None and not path.exists():
        place.look(path)
        place.fetch(path)
    return path


def take_claim(path: Path, mine: dict[str, Any], is_dead: IsDead) -> Claim | None:
    """A lock file at the location that the path belongs to; None for a path of this machine.

    Args:
        path, mine, is_dead: see `Claim`.

    Raises:
        ClaimedError, LocationReadError, LocationWriteError: see `Claim`.
    """
    place = _place_of(path)
    return Claim(place, path, mine, is_dead) if place is not None and place.writing else None


def claimant(path: Path) -> dict[str, Any] | None:
    """Who holds a lock file at a location; None if nobody does, and for a path of this machine.

    Raises:
        LocationReadError: the location does not answer.
    """
    place = _place_of(path)
    return read_claim(place, path) if place is not None and place.writing else None


def lock_files(folder: Path) -> list[Path]:
    """The local paths of all lock files that lay at the location of a folder when it was last looked at."""
    place = _place_of(folder)
    return [place.folder / name for name in place.locks] if place is not None else []


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
    return place.tries(lambda: place.fs.open(target, "rb", block_size=1 << 20), "read", LocationReadError)


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
    if place is not None and place.writing and belongs(place.name(path)):
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
        if folder.absolute().parent == place.folder and (folder / RECORD).is_file():
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
                if not success:
                    place.give_up()
                place.send_all(place.folder)
    except OutputError:
        if success:
            raise


def _place_of(path: Path) -> Place | None:
    """The location that a path belongs to; also in a process that got the path from another."""
    path = path.absolute()
    cache = _cache()
    if cache not in path.parents:
        return None
    folder = cache / path.relative_to(cache).parts[0] / _FILES
    if folder not in _places:
        try:
            state = json.loads((folder.parent / STATE).read_text(encoding="utf-8"))
            place = Place(str(state["url"]), folder, bool(state["writing"]))
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
