"""The cases of `benchmarks/robustness.py`: which clip, with which fault, from which seed, for which half.

Seeds decide everything that is drawn: the room, the place of an overlay, every RANSAC. Half of them are for tuning, and
the figures that are reported come from the other half.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robustness_clips import FRAMES_OF_STRIDE, MOTIONS, PRESETS, VARIANTS, Clip, motion_clip, real_clip, room_clip
from robustness_faults import FAULTS

HALVES = {"tune": 0, "report": 1}
REAL_FRAMES = 150
REAL_STARTS = {"tune": 0, "report": 300}  # of a recording that is long enough; else its beginning
LONG_ENOUGH = ("redkitchen",)
REAL = ("redkitchen", "bundled")
QUICK_FAULTS = ("none", "overlay-15", "mover-70", "attached-half", "mirrored", "zoom", "turned-180", "black")


@dataclass(frozen=True)
class Case:
    """One run of one frontend."""

    group: str  # "rooms", "motions", or the name of a real recording
    what: str  # preset, variant and stride; motion; or fault
    half: str
    seed: int

    @property
    def name(self) -> str:
        """For files, and for `--only`."""
        return f"{self.half}-{self.seed}-{self.group}-{self.what}"

    def clip(self, cache: Path, width: int) -> Clip:
        """The pictures, rendered where they are not in the cache."""
        if self.group == "rooms":
            preset_name, variant, stride = self.what.split("-")
            return room_clip(cache / "rooms", preset_name, variant, self._room_seed(), int(stride))
        if self.group == "motions":
            return motion_clip(cache / "rooms", self.what, self._room_seed())
        start = REAL_STARTS[self.half] if self.group in LONG_ENOUGH else 0
        clip = real_clip(self.group, start, REAL_FRAMES, width)
        return FAULTS[self.what](clip, np.random.default_rng([self.seed, zlib.crc32(self.what.encode())]))

    def _room_seed(self) -> int:
        """A room of its own for each preset and variant, but one for all strides."""
        return 1000 + 100 * self.seed + zlib.crc32(self.what.rsplit("-", 1)[0].encode()) % 100


def cases(halves: list[str], seeds: int, real: list[str], quick: bool) -> list[Case]:
    """All of them, in a fixed order: what differs most from the case before comes first.

    Args:
        halves: of `HALVES`.
        seeds: of each half.
        real: recordings with faults.
        quick: a tenth of them.
    """
    found = []
    for half in halves:
        for seed in range(HALVES[half], 2 * seeds, 2):
            for recording in real:
                found += [Case(recording, fault, half, seed) for fault in FAULTS if not quick or fault in QUICK_FAULTS]
            for stride in (3,) if quick else FRAMES_OF_STRIDE:
                for variant in VARIANTS:
                    presets = PRESETS[1:2] if quick else PRESETS
                    found += [Case("rooms", f"{name}-{variant}-{stride}", half, seed) for name in presets]
            found += [Case("motions", motion, half, seed) for motion in MOTIONS]
    return found
