"""Drawing on video frames with sub-pixel accuracy; colours are RGB, images are RGB (H, W, 3) uint8."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from improvo.report.palettes import RGB
from improvo.types import UInt8

Pixels = NDArray[np.floating]

_SHIFT = 4  # OpenCV's fixed-point digits
_TARGET_WIDTH = 1280  # small frames are enlarged to about this, so that lines and letters are crisp
_BAR_HEIGHT = 30
_PLAIN_WIDTH = 760  # pixels of a picture with letters of plain size
_MARGIN = 8  # pixels beside the text
_SMALLEST = 0.4  # of plain letters; a text that is longer even so is cut
_LETTERS = (235, 235, 235)


class Canvas:
    """A frame, enlarged by a whole number, that is drawn on in the frame's own pixel coordinates.

    Args:
        image: grey (H, W) or RGB (H, W, 3).
        brightness: of the picture below what is drawn.
        width: enlarge up to about this width.
    """

    def __init__(self, image: UInt8, brightness: float = 0.75, width: int = _TARGET_WIDTH) -> None:
        import cv2

        self.scale = max(1, round(width / image.shape[1]))
        rgb = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
        if self.scale > 1:
            rgb = cv2.resize(rgb, None, fx=self.scale, fy=self.scale, interpolation=cv2.INTER_LINEAR)
        self.rgb: UInt8 = np.clip(rgb.astype(np.float32) * brightness, 0, 255).astype(np.uint8)

    def _fixed(self, pixels: Pixels) -> NDArray[np.int32]:
        """Fixed-point coordinates in the enlarged image; pixel centres map to pixel centres."""
        enlarged = (np.asarray(pixels, np.float64) + 0.5) * self.scale - 0.5
        return np.round(np.clip(enlarged, -1e5, 1e5) * (1 << _SHIFT)).astype(np.int32)

    def segments(self, start: Pixels, end: Pixels, colours: UInt8, thickness: int = 1, opacity: float = 1.0) -> None:
        """Straight lines from `start` (N, 2) to `end` (N, 2) in colours (N, 3)."""
        import cv2

        if opacity < 1.0:
            below = self.rgb.copy()
            self.segments(start, end, colours, thickness)
            self.rgb = cv2.addWeighted(self.rgb, opacity, below, 1.0 - opacity, 0.0)
            return
        for a, b, colour in zip(
            self._fixed(start).tolist(), self._fixed(end).tolist(), np.asarray(colours).tolist(), strict=True
        ):
            cv2.line(self.rgb, a, b, colour, thickness, cv2.LINE_AA, _SHIFT)

    def dots(self, centres: Pixels, colours: UInt8, radius: float = 1.5) -> None:
        """Filled circles at (N, 2) in colours (N, 3); the radius is in pixels of the frame before enlargement."""
        import cv2

        size = round(radius * max(1.0, self.scale * 0.75) * (1 << _SHIFT))
        for centre, colour in zip(self._fixed(centres).tolist(), np.asarray(colours).tolist(), strict=True):
            cv2.circle(self.rgb, centre, size, colour, -1, cv2.LINE_AA, _SHIFT)

    def rings(self, centres: Pixels, radii: Pixels, colour: RGB, thickness: int = 2) -> None:
        """Circles at (N, 2) with radii (N,) in pixels of the frame."""
        import cv2

        for centre, radius in zip(self._fixed(centres).tolist(), np.asarray(radii).tolist(), strict=True):
            size = round(radius * self.scale * (1 << _SHIFT))
            cv2.circle(self.rgb, centre, size, colour, thickness, cv2.LINE_AA, _SHIFT)

    def with_caption(self, text: str, ramp: tuple[UInt8, str, str] | None = None) -> UInt8:
        """The picture with a line of text below, and a colour ramp (N, 3) with its two ends in words."""
        return captioned(self.rgb, text, ramp)


def captioned(rgb: UInt8, text: str, ramp: tuple[UInt8, str, str] | None = None) -> UInt8:
    """A picture with a caption bar below; letters grow with the picture, and shrink for text that does not fit.

    The bar's height follows from the picture's width alone, so that pictures of one size stay of one size. A text that
    is too long even so is cut; a ramp that would leave no room for the text is left out.
    """
    import cv2

    width = rgb.shape[1]
    unit = max(1.0, width / _PLAIN_WIDTH)
    thickness = max(1, round(unit))
    bar = np.full((round(_BAR_HEIGHT * unit), width, 3), 24, np.uint8)
    right = width - _MARGIN if ramp is None else _draw_ramp(bar, *ramp, unit=unit)
    font, plain, room = cv2.FONT_HERSHEY_SIMPLEX, 0.5 * unit, right - 2 * _MARGIN

    def length(words: str, size: float) -> int:
        return int(cv2.getTextSize(words, font, size, thickness)[0][0])

    size = plain * min(1.0, max(_SMALLEST, room / max(length(text, plain), 1)))
    shown = text
    while length(shown, size) > room and shown not in ("", "..."):
        shown = shown.removesuffix("...")[:-1] + "..."
    if length(shown, size) <= room:
        cv2.putText(bar, shown, (_MARGIN, round(20 * unit)), font, size, _LETTERS, thickness, cv2.LINE_AA)
    return np.concatenate([rgb, bar])


def _draw_ramp(bar: UInt8, colours: UInt8, low: str, high: str, unit: float) -> int:
    """Draws the ramp at the right end of the bar, where it leaves room; returns where the room for text ends."""
    import cv2

    font, size, thickness = cv2.FONT_HERSHEY_SIMPLEX, 0.45 * unit, max(1, round(unit))
    gap, length, baseline = round(6 * unit), round(120 * unit), round(20 * unit)
    high_width = cv2.getTextSize(high, font, size, thickness)[0][0]
    low_width = cv2.getTextSize(low, font, size, thickness)[0][0]
    end = bar.shape[1] - 2 * gap - high_width
    start = end - length
    if start - low_width - 2 * gap < bar.shape[1] // 4:
        return bar.shape[1] - _MARGIN
    sampled = colours[np.linspace(0, len(colours) - 1, length).astype(int)]
    bar[round(8 * unit) : round(22 * unit), start:end] = sampled[None]
    cv2.putText(bar, high, (end + gap, baseline), font, size, _LETTERS, thickness, cv2.LINE_AA)
    cv2.putText(bar, low, (start - low_width - gap, baseline), font, size, _LETTERS, thickness, cv2.LINE_AA)
    return start - low_width - 2 * gap


def stacked(pictures: list[UInt8], columns: int) -> UInt8:
    """Pictures of one size side by side, in rows of `columns`; the rest of the last row stays dark."""
    height, width = pictures[0].shape[:2]
    columns = min(columns, len(pictures))
    rows = -(-len(pictures) // columns)
    gap = 4
    sheet = np.full((rows * (height + gap) - gap, columns * (width + gap) - gap, 3), 24, np.uint8)
    for number, picture in enumerate(pictures):
        top, left = (number // columns) * (height + gap), (number % columns) * (width + gap)
        sheet[top : top + height, left : left + width] = picture
    return sheet
