"""The version of the files that improvo writes, and what becomes of files of other versions.

One number for all of them, `MAJOR.MINOR`. A new minor version adds to a file what an earlier improvo can leave out of
account; a new major version is one that an earlier improvo would misread. So a file of a later major version is
refused, and everything else is read. Files without a number are from before there was one, and count as `1.0`.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from improvo.errors import InputError

FORMAT = "1.0"
FORMAT_KEY = "format"
_VERSION = re.compile(r"(\d{1,4})\.(\d{1,4})", re.ASCII)


def check_format(found: Any, path: Path, mend: str = "make it again") -> None:
    """Refuse what a later improvo wrote.

    Args:
        found: the version that stands in a file; None where there is none.
        path: of the file or folder, for the message.
        mend: what to do about a version that is no version.

    Raises:
        InputError: a later major version, or no version at all.
    """
    if found is None:
        return
    match = _VERSION.fullmatch(found) if isinstance(found, str) else None
    if match is None:
        raise InputError(f"{path}: is damaged (format {str(found)[:40]!r}); {mend}")
    if int(match[1]) > int(FORMAT.partition(".")[0]):
        raise InputError(
            f"{path}: was written by a later improvo (format {found}, this one reads up to {FORMAT}); "
            "pip install --upgrade improvo"
        )
