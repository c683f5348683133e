"""Colours: the paper's, and a set that colour-blind readers can tell apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from improvo.errors import ConfigError
from improvo.stability.rule import IGNORE, STABLE, UNSTABLE
from improvo.types import UInt8

RAMP_STEPS = 256
RGB = tuple[int, int, int]


@dataclass(frozen=True)
class Palette:
    """Colours as RGB; `ramp` is `jet` or `viridis`."""

    name: str
    ramp: str  # from early, young or small to late, old or large
    stable: RGB
    unstable: RGB
    ignore: RGB
    keypoint: RGB
    flow: RGB

    def ramp_colours(self, values: NDArray[np.number], low: float, high: float) -> UInt8:
        """(N, 3) RGB of values between `low` and `high`; values beyond take the colour of the end."""
        share = np.clip((np.asarray(values, np.float64) - low) / max(high - low, 1e-12), 0.0, 1.0)
        return self.ramp_table()[(share * (RAMP_STEPS - 1) + 0.5).astype(np.int64)]

    def ramp_table(self) -> UInt8:
        """(256, 3) RGB: the ramp without its darkest ends, which are lost on dark pictures."""
        import cv2

        levels = np.rint(np.linspace(0.08, 0.94, RAMP_STEPS) * 255).astype(np.uint8)
        maps = {"jet": cv2.COLORMAP_JET, "viridis": cv2.COLORMAP_VIRIDIS}
        return np.ascontiguousarray(cv2.applyColorMap(levels[:, None], maps[self.ramp])[:, 0, ::-1])

    def ramp_strip(self, length: int = 140) -> UInt8:
        """(length, 3) RGB: the ramp from end to end, for a legend."""
        return self.ramp_colours(np.linspace(0, 1, length), 0, 1)

    def label_colours(self, stability: NDArray[np.integer]) -> UInt8:
        """(N, 3) RGB of the label codes."""
        table = np.zeros((3, 3), np.uint8)
        table[IGNORE], table[UNSTABLE], table[STABLE] = self.ignore, self.unstable, self.stable
        return table[np.asarray(stability, np.int64)]


PALETTES = {
    # paper, Figure "Labeling points with VO": jet; green stable, red unstable, blue ignored; detections in cyan
    "paper": Palette("paper", "jet", (40, 200, 60), (255, 45, 45), (60, 110, 255), (0, 230, 230), (70, 110, 255)),
    # viridis, and colours of Okabe and Ito: told apart with any common colour blindness, and in grey print
    "colour-blind": Palette(
        "colour-blind", "viridis", (0, 158, 115), (230, 159, 0), (86, 130, 200), (240, 228, 66), (86, 180, 233)
    ),
}


def palette(name: str) -> Palette:
    """The palette of that name.

    Raises:
        ConfigError: there is none.
    """
    if name not in PALETTES:
        raise ConfigError(f"palette `{name}` is unknown; choose among {', '.join(PALETTES)}")
    return PALETTES[name]
