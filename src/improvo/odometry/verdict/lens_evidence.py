"""What a window of keyframes says of the focal length: is it what the camera says, and does it stay?

The window is adjusted with a longer and with a shorter focal length, and with one that grows and one that shrinks along
the window. A parabola through the costs gives the best value, and its curvature how well it is determined.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from improvo.backend.settings import SolverSettings
from improvo.backend.solver import solve
from improvo.geometry.camera import Camera
from improvo.odometry.mapping.bundle_adjustment import OBJECTIVE
from improvo.odometry.verdict.evidence_window import EvidenceWindow

_STEP = 0.15  # of the logarithm of the focal length, to both sides
_FARTHEST = 0.7  # a parabola through three costs says nothing of what lies farther off
_SOLVER = SolverSettings(max_iterations=8, relative_decrease=1e-4)


@dataclass(frozen=True)
class LensMeasure:
    """The logarithm of the focal length over that of the camera as given, in one window.

    Attributes:
        frames: first and last frame of the window.
        offset: its mean.
        offset_error: standard error; infinite where the window does not determine it.
        growth: from the first keyframe to the last.
        growth_error: standard error; infinite where the window does not determine it.
    """

    frames: tuple[int, int]
    offset: float
    offset_error: float
    growth: float
    growth_error: float


def measured_lens(window: EvidenceWindow, frames: tuple[int, int], camera: Camera) -> LensMeasure:
    """Adjust a window with other focal lengths.

    Args:
        window: of several keyframes.
        frames: its first and last frame.
        camera: as given.
    """
    mask = window.seen_at_least(3)
    if not mask.any():
        return LensMeasure(frames, 0.0, float("inf"), 0.0, float("inf"))
    along = np.linspace(-0.5, 0.5, len(window))
    problem, rows = window.problem(mask, camera.K)
    equations = 2 * len(problem.keypoints) - 6 * len(window) - 3 * len(rows)

    def cost(offset: float = 0.0, growth: float = 0.0) -> float:
        """Of the best poses and points, if the logarithm of the focal length were another."""
        K, center = camera.K.copy(), camera.K[:2, 2]
        K[[0, 1], [0, 1]] *= np.exp(offset)
        scaled = center + (window.keypoints - center) / np.exp(growth * along)[window.camera, None]
        return float(solve(window.problem(mask, K, scaled)[0], OBJECTIVE, _SOLVER).cost)

    given = cost()
    variance = given / max(equations, 1)
    best_offset = _lowest(cost(offset=-_STEP), given, cost(offset=_STEP), variance)
    best_growth = _lowest(cost(growth=-_STEP), given, cost(growth=_STEP), variance)
    return LensMeasure(frames, *best_offset, *best_growth)


def _lowest(below: float, here: float, above: float, variance: float) -> tuple[float, float]:
    """Where the parabola through three costs is lowest, and the standard error of that place."""
    curvature = 0.5 * (below + above - 2.0 * here) / _STEP**2
    if curvature <= 0.0:
        return 0.0, float("inf")
    lowest = -0.25 * (above - below) / (_STEP * curvature)
    return (lowest, float(np.sqrt(variance / curvature))) if abs(lowest) < _FARTHEST else (0.0, float("inf"))
