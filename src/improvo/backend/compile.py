"""Compiles the kernels of the backend ahead of time, so that a command can announce it.

Numba compiles a kernel when it is first called and caches the machine code beside the source (or in the user's cache
folder, or where NUMBA_CACHE_DIR says), so this takes some seconds once per installation, and a fraction of a second
afterwards.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from improvo.backend.simulated import simulated_window
from improvo.compiled import all_cached


def kernels_are_cached() -> bool:
    """Whether compiled copies of the solver and of the triangulation are on disk."""
    from improvo.backend import arrange, eliminate, linearise, reduced, step
    from improvo.geometry import triangulation_kernels

    return all_cached(
        (
            arrange.sort_observations,
            arrange.find_runs,
            linearise.linearise,
            linearise.evaluate,
            linearise.errors_and_depths,
            eliminate.eliminate,
            reduced.solve_step,
            step.try_step,
            triangulation_kernels.triangulate_all,
        )
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
