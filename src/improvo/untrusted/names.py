"""Numbers in the names of files."""

from __future__ import annotations

import re

_NUMBER = re.compile(r"[0-9]{1,18}")


def number_of(name: str) -> int | None:
    """The number that a name is; None where it is none, or longer than a frame's number can be."""
    return int(name) if _NUMBER.fullmatch(name) else None
