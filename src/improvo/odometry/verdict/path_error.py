"""By how much a path differs from another one, in % of its length, and what a change of its scale would do to it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from improvo.errors import InputError
from improvo.geometry.alignment import align_points, path_length
from improvo.types import Float64, Int64

_ROUNDING = 1e-12  # of coordinates, as a share of their size; positions that differ by less are one
_SMALL_CHANGE = 0.01  # of the logarithm of the scale; the error grows in proportion
_PLACES = 200  # of a long path, evenly, are enough to see how a change of its scale bends it


def error_percent(path: Float64, reference: Float64, length: float | None = None) -> float:
    """Root mean square distance of positions (N, 3) after Sim3, as % of the reference's path.

    Infinite where one of them stands still: Sim3 would shrink any path onto a reference on one spot, and be right.

    Args:
        path: (N, 3).
        reference: (N, 3).
        length: of the reference, where its positions are only some of a longer path.
    """
    size = float(np.abs(reference).max(initial=1.0))
    if np.ptp(reference, axis=0).max() <= _ROUNDING * size:
        return float("inf")
    if length is None:
        length = path_length(reference)
    try:
        aligned = align_points(reference, path, with_scale=True).apply(path)
    except InputError:  # all on one spot
        return float("inf")
    return float(100.0 * np.sqrt(((aligned - reference) ** 2).sum(axis=1).mean()) / max(length, 1e-300))


def scale_leverage(path: Float64, places: Sequence[tuple[int, int]]) -> Float64:
    """What a change of scale at some place of a path does to it.

    Near its ends it moves little, and most in the middle: about 7 % of a straight path, more of one that winds.

    Args:
        path: (N, 3) positions.
        places: first and last index of L stretches of it, behind one position of which all is larger by a factor; the
            one that moves most counts.

    Returns:
        (L,) error after Sim3, in % of the path, per unit of the logarithm of that factor; 0 where it stands still.
    """
    length = path_length(path)
    every = np.unique(np.linspace(0, len(path) - 1, min(len(path), _PLACES)).astype(np.int64))
    moved = {place: _bent(path, place, every, length) for first, last in places for place in range(first, last + 1)}
    return np.array([max(moved[place] for place in range(first, last + 1)) for first, last in places]).reshape(-1)


def _bent(path: Float64, place: int, every: Int64, length: float) -> float:
    some = path[every]
    factor = np.where(every > place, np.exp(_SMALL_CHANGE), 1.0)[:, None]
    moved = error_percent(path[place] + factor * (some - path[place]), some, length)
    return moved / _SMALL_CHANGE if np.isfinite(moved) else 0.0
