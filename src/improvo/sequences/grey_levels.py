"""Pictures of more than 8 bits as 8 bits, the same way in every frame of a recording.

Cameras store 10, 12 or 14 bits in 16-bit files, and thermal cameras use only a small part of the range, so the upper
eight bits show little or nothing. The range that a recording uses is stretched to 8 bits. It is the same for all
frames, because points would flicker otherwise.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from improvo.types import UInt8

SAMPLES = 16  # frames from which the range is found
_PERCENTILES = (0.1, 99.9)
_WIDE = 1 << 14  # a range from here on fills 16 bits well enough to take the upper eight


@dataclass(frozen=True)
class Stretch:
    """The range of values that becomes 0 to 255."""

    low: float
    high: float

    @property
    def note(self) -> str:
        """What is done, for a person."""
        return (
            f"pictures have more than 8 bits and use {self.low:g} to {self.high:g} of them; this range is stretched to "
            "8 bits, the same in all frames"
        )


def stretch_of(pictures: Iterable[np.ndarray]) -> Stretch | None:
    """The range that sampled pictures of one recording need; None where 8 bits, or the upper eight, show them well."""
    lows, highs, floats = [], [], False
    for picture in pictures:
        if picture.dtype == np.uint8:
            return None
        floats |= picture.dtype.kind == "f"
        values = picture[::2, ::2]
        values = values[np.isfinite(values)] if floats else values
        if values.size:
            low, high = np.percentile(values, _PERCENTILES)
            lows.append(float(low))
            highs.append(float(high))
    if not lows:
        return None
    low, high = min(lows), max(highs)
    if high - low >= _WIDE and not floats:
        return None
    return Stretch(low, max(high, low + (1e-6 if floats else 1.0)))


def to_8_bits(picture: np.ndarray, stretch: Stretch | None = None) -> UInt8:
    """A picture (H, W) or (H, W, 3) of any depth as 8 bits; without a stretch, the upper eight."""
    if picture.dtype == np.uint8:
        return picture
    if stretch is None:
        if picture.dtype == np.uint16:
            return (picture >> 8).astype(np.uint8)
        stretch = stretch_of([picture]) or Stretch(0.0, 1.0)
    scaled = (np.nan_to_num(picture.astype(np.float32), nan=stretch.low) - stretch.low) * (
        255.0 / (stretch.high - stretch.low)
    )
    return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)
