"""Names of files that no system takes, said before anything is done with them."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

from improvo.errors import InputError

_REASONS = {errno.ENAMETOOLONG: "the name is too long", errno.ELOOP: "is a link that leads to itself"}


def is_text(path: Path) -> bool:
    """Whether a name is text; Linux takes any bytes, which Python shows as halves of surrogates."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return False
    return True


def as_text(name: str) -> str:
    """A name for titles: what is no text becomes a question mark in a diamond, which fonts and tables can show."""
    return "".join("\N{REPLACEMENT CHARACTER}" if 0xD800 <= ord(each) <= 0xDFFF else each for each in name)


def is_file(path: Path) -> bool:
    """Whether there is such a file, whatever its name."""
    try:
        return path.is_file()
    except OSError:  # a name that is longer than any can be, or in a folder that may not be looked into
        return False


def check_path(path: Path, reachable: bool = False) -> Path:
    """The path, if the system can look it up; whether something is there does not matter.

    Args:
        path: of anything.
        reachable: whether this process must be allowed to look it up; without that, Python raises what is not caught
            whenever somebody asks if it is there.

    Raises:
        InputError: it holds NUL, is too long, is a loop of links, or lies in a folder that may not be looked into.
    """
    try:
        os.stat(path)
    except ValueError:  # NUL, or characters that the system's encoding lacks
        raise InputError(f"{str(path)!r}: is no name that a file can have; check the path") from None
    except OSError as error:
        if error.errno in _REASONS:
            shown = str(path) if len(str(path)) <= 100 else f"{str(path)[:97]}..."
            raise InputError(f"{shown}: {_REASONS[error.errno]}; check the path") from None
        if reachable and isinstance(error, PermissionError):
            raise InputError(f"{path}: no permission to look into its folder; choose another, or change that") from None
    return path


def check_readable(path: Path) -> Path:
    """The path, unless something is there that this process may not read; readers would call it damaged, or missing.

    Raises:
        InputError: no permission.
    """
    try:
        is_folder = stat.S_ISDIR(os.stat(path).st_mode)
    except (OSError, ValueError):  # not there, or in a folder that may not be looked into: for others to say
        return path
    if not os.access(path, os.R_OK | os.X_OK if is_folder else os.R_OK):
        raise InputError(f"{path}: no permission to read it; choose another, or change that")
    return path


def check_is_file(path: Path) -> Path:
    """The path, unless it leads to a pipe or a device: to read one may take forever, and all memory.

    A pipe that a shell hands over as a file (`<(...)`, in `/dev/fd`) has somebody who writes to it.

    Raises:
        InputError: it does.
    """
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):  # for whoever reads it to say
        return path
    handed_over = stat.S_ISFIFO(mode) and path.parts[:3] == ("/", "dev", "fd")
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode) or handed_over):
        raise InputError(f"{path}: is a pipe or a device, not a file; give a file")
    return path
