"""Levenberg-Marquardt over poses and points: the fast solver of the paper's objective.

The loop is here, in Python; its parts are compiled and release the GIL. One thread, no BLAS: the same problem gives
the same bits.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from improvo.backend.arrange import arrange
from improvo.backend.eliminate import eliminate
from improvo.backend.linearise import errors_and_depths, evaluate, linearise
from improvo.backend.problem import BundleProblem, BundleResult
from improvo.backend.reduced import solve_step
from improvo.backend.settings import ObjectiveSettings, SolverSettings
from improvo.backend.step import try_step

PARTS = ("arrange", "linearise", "eliminate", "solve", "evaluate")


def solve(
    problem: BundleProblem,
    objective: ObjectiveSettings | None = None,
    settings: SolverSettings | None = None,
    timed: bool = False,
) -> BundleResult:
    """Minimise Omega (see `improvo.backend.objective`) over the free poses and points.

    Args:
        timed: fill `BundleResult.seconds` with the processor time of each of PARTS.

    Returns:
        The best state seen; its cost is never above the initial one, and never NaN.
    """
    objective = objective or ObjectiveSettings()
    settings = settings or SolverSettings()
    clock = _Stopwatch(timed)
    with clock("arrange"):
        constants, observations, system = arrange(problem, objective)
        poses = np.array(problem.cam_from_world, np.float64, order="C")
        points = np.array(problem.points, np.float64, order="C")
        new_poses, new_points = poses.copy(), points.copy()
    with clock("evaluate"):
        cost = initial_cost = evaluate(constants, observations, poses, points)

    damping, growth = settings.initial_damping, 2.0
    iterations = 0
    must_linearise, converged = True, cost == 0.0
    while iterations < settings.max_iterations and not converged and damping <= settings.max_damping:
        iterations += 1
        if must_linearise:
            with clock("linearise"):
                linearise(constants, observations, system, poses, points)
            must_linearise = False
        with clock("eliminate"):
            solvable = eliminate(observations, system, damping, settings.min_diagonal)
        with clock("solve"):
            solvable = solvable and solve_step(observations, system)
        decrease, gain = -np.inf, -np.inf
        if solvable:
            with clock("evaluate"):
                new_cost, promised = try_step(
                    constants, observations, system, damping, settings.min_diagonal,
                    poses, points, new_poses, new_points,
                )  # fmt: skip
            decrease = cost - new_cost
            converged = bool(abs(decrease) <= settings.relative_decrease * cost)
            # twice, because the promise is of half the objective; a cost that is not finite fails both comparisons
            gain = decrease / (2.0 * promised) if promised > 0.0 else -np.inf
        if decrease > 0.0 and gain >= settings.min_gain:
            poses, new_poses, points, new_points = new_poses, poses, new_points, points
            cost, must_linearise = new_cost, True
            damping = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), settings.min_damping)
            growth = 2.0
        else:
            damping, growth = damping * growth, growth * 2.0

    converged = converged or damping > settings.max_damping
    errors, depths = errors_and_depths(constants, observations, poses, points)
    return BundleResult(
        poses, points, errors, depths, float(cost), float(initial_cost), iterations, converged, clock.seconds
    )


class _Stopwatch:
    """Processor seconds of this thread per part, which a busy machine disturbs less; does nothing unless asked."""

    def __init__(self, running: bool) -> None:
        self.running = running
        self.seconds: dict[str, float] = dict.fromkeys(PARTS, 0.0) if running else {}

    def __call__(self, part: str) -> _Stopwatch:
        self.part = part
        return self

    def __enter__(self) -> None:
        if self.running:
            self.start = time.thread_time()

    def __exit__(self, *_: Any) -> None:
        if self.running:
            self.seconds[self.part] += time.thread_time() - self.start
