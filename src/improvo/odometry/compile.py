"""Compiling everything that the odometry needs ahead of time, so that the first frames do not look stuck."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from improvo.backend.compile import compile_kernels
from improvo.odometry.projection_search import match_by_projection
from improvo.tracking.matching import match_units


def compile_odometry(progress: Callable[[str], None] | None = None) -> None:
    """Run every compiled kernel once; `progress` is told before it takes seconds, once per installation."""
    compile_kernels(progress)
    units = np.eye(4, dtype=np.float32)
    pixels = np.arange(8.0).reshape(4, 2)
    match_units(units, units)
    match_by_projection(pixels, units, pixels, units, radius=2.0, max_distance=0.7)
