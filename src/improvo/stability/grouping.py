"""Rows and medians by group: what tables of tracks and observations are asked for."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from improvo.errors import InputError
from improvo.types import Float64, Int64


def rows_of(ids: Int64, wanted: Int64) -> Int64:
    """The row of `ids` (unique) that holds each wanted id.

    Raises:
        InputError: none holds one of them.
    """
    order = np.argsort(ids, kind="stable")
    rows = np.append(order, -1)[np.searchsorted(ids, wanted, sorter=order)]
    missing = np.flatnonzero((rows < 0) | (np.append(ids, -1)[rows] != wanted))
    if len(missing):
        raise InputError(f"track {wanted[missing[0]]} is in one table and not in the other; label the recording again")
    return rows


def medians(group: Int64, values: NDArray[Any], groups: int) -> Float64:
    """Median of the finite values of each group; of two middle values, their mean.

    Args:
        group: (M,) number of the group that each value belongs to.
        values: (M,)
        groups: how many there are; they are numbered from 0.

    Returns:
        (groups,) NaN for a group without a finite value.
    """
    known = np.isfinite(values)
    order = np.lexsort((values[known], group[known]))
    ordered, group = values[known][order].astype(np.float64), group[known][order]
    start, end = (np.searchsorted(group, np.arange(groups), side=side) for side in ("left", "right"))
    some = end > start
    low, high = (start + (end - start - 1) // 2)[some], (start + (end - start) // 2)[some]
    result = np.full(groups, np.nan)
    result[some] = 0.5 * (ordered[low] + ordered[high])
    return result
