"""Simulated rooms with exact depth, poses and causes of instability, and the small recording that ships with improvo.

It imports `geometry` and `jobs`. Open `generate.py` first: a recording from its settings. `scene.py` puts one room
together.
"""

from __future__ import annotations

from pathlib import Path


def bundled_sequence() -> Path:
    """The folder of the bundled recording (TUM RGB-D layout with labels), for `improvo demo` and for tests."""
    return Path(__file__).parent / "bundled" / "demo"
