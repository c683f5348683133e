"""Rows of numbers that a file gives as text, as lists, or not at all."""

from __future__ import annotations

from typing import Any

import numpy as np

from improvo.types import Float64


def numbers(values: Any, count: int) -> Float64:
    """(count,) float64, NaN where `values` is anything else."""
    try:
        result = np.array(values, np.float64).ravel()
    except (TypeError, ValueError, OverflowError, RecursionError):
        return np.full(count, np.nan)
    return result if len(result) == count else np.full(count, np.nan)
