"""What sampled pictures of a recording look like, in numbers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from improvo.errors import InputError
from improvo.sequences.sequence import Sequence
from improvo.sequences.still import StillPixels
from improvo.types import Float64, UInt8

DUPLICATE_LEVELS = 0.6  # mean grey levels between neighbours at 160 pixels width: less is the same picture again
BLUR_SHARE = 0.5  # of the recording's own sharpness
CLIPPED = (5, 250)  # grey levels
_WORK_WIDTH = 320
_DUPLICATE_WIDTH = 160
_LIT = 0.1  # of the picture; where less is ever lit, the recording is dark as a whole


def measure(sequence: Sequence, samples: int, progress: Callable[[int], object]) -> dict[str, Any]:
    """Blur, exposure, texture, repetition and what never moves, from pairs of neighbouring frames.

    Args:
        sequence: the recording.
        samples: pairs to decode, spread over it.
        progress: called with 1 for each pair.
    """
    starts = np.unique(np.linspace(0, max(0, len(sequence) - 2), min(samples, max(1, len(sequence) - 1))).astype(int))
    rows: list[Float64] = []
    exposure = _Exposure()
    duplicates, pairs, with_depth, depth_median = 0, 0, 0, []
    previous: tuple[int, UInt8] | None = None
    still = StillPixels()
    for start in starts.tolist():
        pair = []
        for row in (start, start + 1)[: len(sequence)]:
            if previous is not None and previous[0] == row:
                pair.append(previous[1])
                continue
            image = _try(sequence, row)
            if image is not None:
                small = _small(image)
                rows.append(_look(small))
                exposure.add(small)
                still.add(image)
                pair.append(image)
                previous = (row, image)
        if len(pair) == 2:
            pairs += 1
            duplicates += bool(_difference(pair[0], pair[1]) < DUPLICATE_LEVELS)
        depth = sequence.depth(start)
        if depth is not None:
            with_depth += 1
            depth_median.append(float(np.nanmedian(depth)) if np.isfinite(depth).any() else np.nan)
        progress(1)
    looks = np.stack(rows) if rows else np.zeros((1, 2))
    brightness, clipped = exposure.measured()
    sharp = float(np.percentile(looks[:, 0], 90))
    depth_facts = None
    if with_depth:
        median = float(np.nanmedian(depth_median)) if np.isfinite(depth_median).any() else None
        depth_facts = {"share_of_frames": round(with_depth / len(starts), 3), "median": median}
    return {
        "sampled": len(rows),
        "duplicates": round(duplicates / pairs, 3) if pairs else 0.0,
        "blurred": round(float((looks[:, 0] < BLUR_SHARE * sharp).mean()), 3) if sharp > 0 else 1.0,
        "brightness": round(brightness, 1),
        "clipped": round(clipped, 3),
        "corners": int(np.median(looks[:, 1])),
        "still": round(still.share(sequence.mask(0)), 4),
        "depth": depth_facts,
    }


def _try(sequence: Sequence, row: int) -> UInt8 | None:
    try:
        return sequence[row].image
    except InputError:
        return None


def _small(image: UInt8) -> UInt8:
    width = min(_WORK_WIDTH, image.shape[1])
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _look(small: UInt8) -> Float64:
    """Sharpness (second over first derivatives, so that little texture is not blur), corners."""
    # kernels of 5 pixels, under which the rounding to grey levels does not count as detail
    across, down = (cv2.Sobel(small, cv2.CV_32F, *order, ksize=5) for order in ((1, 0), (0, 1)))
    gradient = float(np.sqrt((across**2 + down**2).mean()))
    sharpness = float(cv2.Laplacian(small, cv2.CV_32F, ksize=5).std()) / (gradient + 1.0)
    corners = cv2.goodFeaturesToTrack(small, 500, 0.01, 5, blockSize=5)
    strong = 0 if corners is None or small.std() < 2 else len(corners)
    return np.array([sharpness, strong], np.float64)


class _Exposure:
    """Brightness of the pictures of one recording, all of one size.

    Where none of them is lit, as around the round picture of an endoscope or of a fisheye lens, nothing is too dark.
    """

    def __init__(self) -> None:
        self._pictures: list[UInt8] = []

    def add(self, small: UInt8) -> None:
        """One more picture."""
        self._pictures.append(small)

    def measured(self) -> tuple[float, float]:
        """Median grey level, and the share of pixels that are black or white."""
        if not self._pictures:
            return 0.0, 0.0
        lit = np.max(self._pictures, axis=0) > CLIPPED[0]
        used = lit if lit.mean() > _LIT else np.ones_like(lit)
        pixels = [picture[used] for picture in self._pictures]
        clipped = [float(((levels <= CLIPPED[0]) | (levels >= CLIPPED[1])).mean()) for levels in pixels]
        return float(np.median([np.median(levels) for levels in pixels])), float(np.mean(clipped))


def _difference(a: UInt8, b: UInt8) -> float:
    height = max(1, round(a.shape[0] * _DUPLICATE_WIDTH / a.shape[1]))
    small = [cv2.resize(image, (_DUPLICATE_WIDTH, height), interpolation=cv2.INTER_AREA) for image in (a, b)]
    return float(cv2.absdiff(small[0], small[1]).mean())
