"""Compiling the kernels ahead of time, so that a progress line can say so.

Numba compiles a kernel when it is first called and caches the machine code beside the source (or in the user's cache
folder, or where NUMBA_CACHE_DIR says), so this takes seconds once per installation and a fraction of one afterwards.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from improvo.backend.simulated import simulated_window


def kernels_are_cached() -> bool:
    """Whether a compiled copy of the solver is on disk; it may still be stale, which only costs a compilation."""
    from improvo.backend import reduced
    from improvo.geometry import triangulation_kernels

    kernels = (reduced.solve_step, triangulation_kernels.triangulate_all)
    folders = [kernel.stats.cache_path for kernel in kernels]  # None where nothing can be cached
    return all(
        folder is not None and any(Path(folder).glob(f"*{kernel.__name__}-*.nbi"))
        for kernel, folder in zip(kernels, folders, strict=True)
    )


def compile_kernels(progress: Callable[[str], None] | None = None) -> None:
    """Run every kernel once on a tiny problem.

    Args:
        progress: is told, in a few words, before a compilation that takes seconds; not called when all is cached.
    """
    if progress is not None and not kernels_are_cached():
        progress("compiling the solver (once, about 15 s)")
    from improvo.backend.solver import solve
    from improvo.geometry.triangulation import triangulate_tracks

    problem = simulated_window(cameras=4, points=6).problem
    solve(problem)
    order = np.argsort(problem.point_index, kind="stable")
    counts = np.bincount(problem.point_index, minlength=len(problem.points))
    offsets = np.concatenate([[0], np.cumsum(counts)])
    triangulate_tracks(
        problem.keypoints[order], problem.camera_index[order], offsets, problem.cam_from_world, problem.K
    )
