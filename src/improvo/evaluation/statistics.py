"""Accuracy over thresholds, the areas under curves, and bootstrap intervals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from improvo.types import Float64


def below(errors: Float64, threshold: float) -> NDArray[np.bool_]:
    """Which `errors` (N,) are strictly below the threshold, as in the paper's "< 5"; a failure is an error of inf."""
    return np.asarray(errors < threshold)


def accuracy_curve(errors: Float64, thresholds: Float64) -> Float64:
    """Share of `errors` (N,) strictly below each of `thresholds` (T,)."""
    return np.searchsorted(np.sort(errors), thresholds, side="left") / len(errors)


def area_shares(errors: Float64, limit: float) -> Float64:
    """What each error adds to the area under the accuracy curve from 0 to `limit`, divided by `limit`.

    Their mean is the area, exactly: an error e is counted from e to the limit. 1 where no error is left.
    """
    return np.clip(1.0 - errors / limit, 0.0, None)


def average_precision(scores: Float64, right: NDArray[np.bool_], possible: int | None = None) -> float | None:
    """Precision averaged over the steps of recall; detections of equal score count as one step.

    Args:
        scores: (N,) of the detections, larger is accepted earlier.
        right: (N,) whether a detection is right.
        possible: number of right detections there could be; by default those of `right`.

    Returns:
        None where nothing could be right.
    """
    possible = int(right.sum()) if possible is None else possible
    if possible == 0:
        return None
    order = np.argsort(-scores, kind="stable")
    hits = np.cumsum(right[order])
    last = np.flatnonzero(np.diff(scores[order], append=np.nan))  # of each step
    precision = hits[last] / (last + 1)
    return float((np.diff(hits[last] / possible, prepend=0.0) * precision).sum())


class Bootstrap:
    """Percentile intervals of means over the same resamples of the same trials (Efron 1979).

    One object serves every frontend, so that differences between frontends are taken over paired resamples.

    Args:
        count: number of trials.
        seed: of the resamples.
        resamples: how many.
        confidence: of the interval.
        block: neighbouring trials that are drawn together, where what is true of one is likely true of the next
            (the circular block bootstrap, Politis and Romano 1992); 1 draws each for itself.
    """

    def __init__(self, count: int, seed: int, resamples: int = 1000, confidence: float = 0.95, block: int = 1) -> None:
        rng = np.random.default_rng(seed)
        if block == 1:
            drawn = rng.multinomial(count, np.full(count, 1.0 / count), size=resamples)
        else:
            first = rng.integers(0, count, size=(resamples, -(-count // block), 1))
            trials = (first + np.arange(block)).reshape(resamples, -1)[:, :count] % count
            drawn = np.stack([np.bincount(each, minlength=count) for each in trials])
        self._weights = drawn.astype(np.float32) / np.float32(count)
        self._percentiles = [50 * (1 - confidence), 50 * (1 + confidence)]

    def interval(self, values: NDArray[np.generic]) -> tuple[float, float]:
        """Interval of the mean of finite `values` (N,)."""
        return self.percentiles(self.means(values))

    def means(self, values: NDArray[np.generic]) -> Float64:
        """Mean of finite `values` (N,) in every resample."""
        return np.asarray(self._weights @ values.astype(np.float32))

    def percentiles(self, means: Float64) -> tuple[float, float]:
        """The interval that holds the chosen share of the resampled `means`."""
        low, high = np.percentile(means, self._percentiles)
        return float(low), float(high)
