"""Simulated rooms with exact ground truth, and the small sequence that ships with improvo."""

from __future__ import annotations

from pathlib import Path


def bundled_sequence() -> Path:
    """The folder of the bundled recording (TUM RGB-D layout with labels), for `improvo demo` and for tests."""
    return Path(__file__).parent / "bundled" / "demo"
