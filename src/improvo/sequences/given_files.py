"""The files that a user gives beside a recording, camera and mask: where they lie, and what is in them."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

from improvo.sequences.base import SequenceSettings

CONTENTS = {"sequence.camera": "camera_content", "sequence.mask": "mask_content"}  # settings -> entries below
_SHOWN = 16  # hexadecimal digits of a hash, enough to tell files apart
_FOLDER_OF_CAMERAS = "a folder with a camera for each recording"


def with_absolute_files(settings: SequenceSettings) -> SequenceSettings:
    """The settings with camera and mask found from any working folder, for what is read again later."""
    return replace(settings, camera=_absolute(settings.camera), mask=_absolute(settings.mask))


def contents_of_given(settings: SequenceSettings) -> dict[str, str]:
    """What results depend on beside the settings themselves: camera and mask by what is in them, not by their names.

    A folder of cameras grows with the recordings, so it counts as one, whatever is in it.

    Returns:
        `camera_content` and `mask_content`: a hash of files, the camera's own numbers, or nothing where none is given.
    """
    camera = settings.camera or ""
    return {
        "camera_content": _FOLDER_OF_CAMERAS if camera and Path(camera).is_dir() else _content(camera),
        "mask_content": mask_content(settings),
    }


def mask_content(settings: SequenceSettings) -> str:
    """The entry `mask_content` of `contents_of_given` alone."""
    return _content(settings.mask or "")


def _absolute(given: str | None) -> str | None:
    return str(Path(given).absolute()) if given is not None and _is_there(Path(given)) else given


def _content(given: str) -> str:
    """Of a file, of all files of a folder with their names, or the text itself where it names neither."""
    path = Path(given)
    if not given or not _is_there(path):
        return given
    digest = hashlib.sha256()
    for file in [path] if path.is_file() else sorted(each for each in path.rglob("*") if each.is_file()):
        name = "" if file == path else file.relative_to(path).as_posix()
        digest.update(f"{name}\0{file.stat().st_size}\0".encode("utf-8", "surrogateescape"))
        with file.open("rb") as opened:
            while part := opened.read(1 << 20):
                digest.update(part)
    return f"sha256:{digest.hexdigest()[:_SHOWN]}"


def _is_there(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # a text that no file can be named by
        return False
