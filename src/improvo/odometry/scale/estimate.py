"""A scale from many measurements of it: the median, how sure it is, and whether it changes along the run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from improvo.types import Float64

_ROBUST = 1.4826  # median absolute deviation to standard deviation
_BLOCKS = 10  # stretches of a run whose medians count as independent
_FEW = 3  # measurements from which on a spread says something


@dataclass(frozen=True)
class ScaleEstimate:
    """The scale of one segment."""

    metres_per_unit: float
    relative_error: float | None  # standard error; None where nothing tells
    measurements: int  # frames, stretches or markers that it comes from
    change: float | None = None  # relative, from the first to the last third of the segment; None where it is not known

    @property
    def surety(self) -> str:
        """How sure it is, for a person."""
        return "" if self.relative_error is None else f"±{100 * self.relative_error:.2g} %"


def from_measurements(factors: Float64, places: Float64) -> ScaleEstimate:
    """The median of metres per unit (N,), with the standard error of what neighbours in time do not share.

    Args:
        factors: (N,) positive.
        places: (N,) of each along the run, in order, such as its frame.
    """
    order = np.argsort(places, kind="stable")
    factors = factors[order]
    middle = float(np.median(factors))
    blocks = np.array([np.median(part) for part in np.array_split(factors, min(_BLOCKS, len(factors)))])
    error = None
    if len(blocks) >= _FEW:
        # neighbours err alike, so that blocks count and not single frames; 1.25: a median is less exact than a mean
        error = 1.25 * robust_spread(blocks) / np.sqrt(len(blocks)) / middle
    thirds = np.array_split(factors, 3)
    change = float(np.median(thirds[2]) / np.median(thirds[0]) - 1) if len(factors) >= 3 * _FEW else None
    return ScaleEstimate(middle, None if error is None else float(error), len(factors), change)


def robust_spread(values: Float64) -> float:
    """Standard deviation by the median absolute deviation; by the deviation itself where they are few."""
    if len(values) < 2 * _FEW:
        return float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
    return _ROBUST * float(np.median(np.abs(values - np.median(values))))
