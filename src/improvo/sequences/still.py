"""Pixels that never change while the rest of the picture does: overlays, letterbox bars, the vehicle with the camera.

Such pixels are found by their gradient, not by their brightness: the brightness of a bonnet changes with the light, and
that of a white ceiling never changes even if the camera moves. Gradients of moving content point in all directions and
cancel out. Those of an overlay add up and have the same length in every picture.
"""

from __future__ import annotations

import contextlib

import cv2
import numpy as np

from improvo.errors import InputError
from improvo.sequences.base import Recording, UnreadableFrameError
from improvo.sequences.images import grey
from improvo.types import Float32, Int64, Mask, UInt8

_WIDTH = 320  # pixels that are looked at
_FRAMES = 12  # fewer say nothing
_SMOOTHING = 0.8  # pixels
_STRUCTURE = 2.5  # grey levels per pixel of gradient
_ALIKE = 0.85  # length of the mean gradient over mean length: 1 where it never changes
_STEADY = 0.5  # deviation of the gradient's length over its mean
_MOVING = 0.6  # `_ALIKE` of the median pixel with structure beyond which hardly anything moves
_FLAT = 3.0  # deviation in grey levels of a pixel without structure that belongs to what stands still around it
_FRAMED = 0.5  # of a flat area's outline that stands still; sky and asphalt in real drives and flights: up to 0.3
_SPECK = 24  # pixels; smaller places are chance
_GAP = 7  # pixels between parts of one overlay, such as the digits of a clock
_MARGIN = 2  # pixels around what was found


class StillPixels:
    """Collects pictures of one recording, all of one size."""

    def __init__(self) -> None:
        self._count = 0
        self._sums: Float32 = np.zeros((6, 0, 0), np.float32)
        self._size = 0, 0

    def add(self, image: UInt8) -> None:
        """One more picture (H, W)."""
        height, width = image.shape
        if self._count and self._size != (width, height):
            return
        shape = max(1, round(height * _WIDTH / width))
        small = cv2.resize(image, (_WIDTH, shape), interpolation=cv2.INTER_AREA).astype(np.float32)
        smooth = cv2.GaussianBlur(small, (0, 0), _SMOOTHING)
        across, down = (cv2.Sobel(smooth, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
        squared = across**2 + down**2
        found = np.stack([across, down, np.sqrt(squared), squared, small, small**2]).astype(np.float32)
        self._sums = found if self._count == 0 else self._sums + found
        self._size = width, height
        self._count += 1

    def share(self, used: Mask | None = None) -> float:
        """The share of the picture; 0 if there were too few pictures, or if hardly anything in them moves.

        Args:
            used: (H, W) what is not masked already.
        """
        if not self._count:
            return 0.0
        found = self._found()
        if used is not None:
            found &= cv2.resize(used.astype(np.uint8), found.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
        return float(found.mean())

    def mask(self) -> UInt8:
        """(H, W) as a mask: black where the picture never changes, white elsewhere."""
        found = self._found().astype(np.uint8)
        black = cv2.resize(found, self._size, interpolation=cv2.INTER_NEAREST)
        return np.where(black > 0, np.uint8(0), np.uint8(255))

    def _found(self) -> Mask:
        shape = self._sums.shape[1:]
        if self._count < _FRAMES:
            return np.zeros(shape, np.bool_)
        across, down, length, squared, grey, grey_squared = self._sums / self._count
        alike = np.hypot(across, down) / np.maximum(length, 1e-6)
        steady = np.sqrt(np.maximum(squared - length**2, 0)) / np.maximum(length, 1e-6)
        structured = length > _STRUCTURE
        if not structured.any() or np.median(alike[structured]) > _MOVING:
            return np.zeros(shape, np.bool_)
        found = _without_specks(_closed(structured & (alike > _ALIKE) & (steady < _STEADY)))
        flat = np.sqrt(np.maximum(grey_squared - grey**2, 0)) < _FLAT
        return _grown(_filled(_closed(found | _framed(flat & ~found, found))), _MARGIN) if found.any() else found


def still_mask(recording: Recording, indices: Int64, samples: int) -> UInt8:
    """(H, W) mask of a recording's own images.

    Args:
        recording: whose images.
        indices: (N,) its frames that are used.
        samples: so many of them are looked at.

    Raises:
        InputError: nothing stands still while the rest moves.
    """
    still = StillPixels()
    for row in np.unique(np.linspace(0, len(indices) - 1, min(samples, len(indices))).astype(int)):
        with contextlib.suppress(UnreadableFrameError):
            still.add(grey(recording.image(int(indices[row]))))
    if still.share() == 0:
        raise InputError(
            f"{recording.path}: nothing was found that never changes while the rest of the picture does, so no mask "
            "is written; paint one by hand, white where the picture is to be used"
        )
    return still.mask()


def _closed(mask: Mask) -> Mask:
    """With gaps of a few pixels filled; the outside of the picture is not a gap."""
    padded = cv2.copyMakeBorder(mask.astype(np.uint8), _GAP, _GAP, _GAP, _GAP, cv2.BORDER_CONSTANT, value=0)
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, np.ones((_GAP, _GAP), np.uint8))
    return np.asarray(closed[_GAP:-_GAP, _GAP:-_GAP] > 0)


def _without_specks(mask: Mask) -> Mask:
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= _SPECK
    large[0] = False
    return np.asarray(large[labels], np.bool_)


def _framed(mask: Mask, frame: Mask) -> Mask:
    """The connected parts of a mask whose outline within the picture lies mostly on the frame.

    The bar of a letterbox and the inside of a clock are so. A sky or a road touches something far away that stands
    still, too, but most of its outline moves.
    """
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    near = _grown(frame, 1)
    outline, framed = np.zeros(count), np.zeros(count)
    for side in range(4):  # the neighbours to the right, below, to the left, above
        part, beside, by_frame = (np.rot90(values, side) for values in (labels, mask, near))
        edge = part[:, :-1][~beside[:, 1:]]
        outline += np.bincount(edge, minlength=count)
        framed += np.bincount(edge, by_frame[:, 1:][~beside[:, 1:]], minlength=count)
    kept = (framed > 0) & (framed >= _FRAMED * outline)
    kept[0] = False
    return np.asarray(kept[labels], np.bool_)


def _filled(mask: Mask) -> Mask:
    """Also what the mask encloses."""
    padded = cv2.copyMakeBorder((~mask).astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=1)
    _, labels = cv2.connectedComponents(padded, connectivity=4)
    return np.asarray(labels[1:-1, 1:-1] != labels[0, 0])


def _grown(mask: Mask, pixels: int) -> Mask:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((2 * pixels + 1,) * 2, np.uint8)) > 0)
