"""Recordings of every format in, `Frame`s out: grey, undistorted, resized, with times, depth and ground truth.

It imports `geometry` and `untrusted`. Open `base.py` first: `Recording`, the interface of a format. `opening.py`
recognises a path; its table `FORMATS` lists all formats. A new format is one file with a subclass of `Recording`, and
one row in that table; `seven_scenes.py` is a short one to copy.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from improvo.geometry.trajectory_files import read_trajectory, write_trajectory
    from improvo.sequences.base import Recording, SequenceSettings, SkippedFrame
    from improvo.sequences.opening import open_recording, open_sequence
    from improvo.sequences.sequence import Sequence

_PUBLIC = {
    "open_sequence": "sequences.opening",
    "open_recording": "sequences.opening",
    "Sequence": "sequences.sequence",
    "SequenceSettings": "sequences.base",
    "Recording": "sequences.base",
    "SkippedFrame": "sequences.base",
    "read_trajectory": "geometry.trajectory_files",
    "write_trajectory": "geometry.trajectory_files",
}

__all__ = [
    "Recording",
    "Sequence",
    "SequenceSettings",
    "SkippedFrame",
    "open_recording",
    "open_sequence",
    "read_trajectory",
    "write_trajectory",
]


def __getattr__(name: str) -> Any:
    """Import public names when they are first used, so that importing the room costs nothing."""
    if name in _PUBLIC:
        return getattr(importlib.import_module(f"improvo.{_PUBLIC[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
