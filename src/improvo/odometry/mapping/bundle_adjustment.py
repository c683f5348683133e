"""Bundle adjustment of a set of views (paper, "VO Backend"): build the problem, solve, prune, solve again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from improvo.backend.problem import BundleProblem, BundleResult
from improvo.backend.settings import ObjectiveSettings, SolverSettings
from improvo.backend.solver import solve
from improvo.odometry.point_store import PointStore
from improvo.odometry.view import NO_POINT, View
from improvo.types import Float64, Int64, Mask

OBJECTIVE = ObjectiveSettings(depth_weight=0.0)  # the paper's, without the regulariser, which is wrong outdoors
SOLVER = SolverSettings(max_iterations=8, relative_decrease=1e-3)  # the next frame's solve goes on from there
_WORTH_SOLVING_AGAIN = 0.01  # share of observations dropped; where fewer were, the next frame's solve is enough


@dataclass(frozen=True)
class WindowReport:
    """How well the window fits after its adjustment."""

    mean_error: float  # pixels, over the observations kept; NaN without any
    kept: int  # observations
    dropped: int  # observations over the maximal error or behind the camera
    iterations: int


@dataclass(frozen=True)
class _Observations:
    """The observations of a window's points, and where they came from."""

    camera: Int64  # (O,) index into views
    row: Int64  # (O,) keypoint of that view
    point: Int64  # (O,) index into ids
    ids: Int64  # (M,) map points


def adjust(
    free: Sequence[View],
    fixed: Sequence[View],
    store: PointStore,
    K: Float64,
    objective: ObjectiveSettings,
    solver: SolverSettings,
    max_error: float | None,
) -> WindowReport:
    """Adjust the poses of free views and all points that they observe.

    Observations that end over the largest error or behind the camera are dropped. If they were many, the window is
    solved again.

    Args:
        free: views whose poses are adjusted.
        fixed: views whose poses stay; their observations of the same points count.
        store: the points; adjusted in place.
        K: (3, 3) intrinsic matrix.
        objective: of the bundle adjustment.
        solver: when it stops.
        max_error: pixels; None drops nothing (mode `paper`).
    """
    views = [*free, *fixed]
    is_fixed = np.arange(len(views)) >= len(free)
    observations = _gather(views, len(free))
    if len(observations.camera) == 0:
        return WindowReport(float("nan"), 0, 0, 0)
    result = _solve(views, is_fixed, observations, store, K, objective, solver)
    if max_error is None:
        return WindowReport(float(result.errors.mean()), len(result.errors), 0, result.iterations)
    iterations = result.iterations
    bad = _misfits(result, max_error)
    dropped = int(bad.sum())
    _drop(views, observations, bad)
    if dropped > _WORTH_SOLVING_AGAIN * len(bad):
        observations = _gather(views, len(free))
        result = _solve(views, is_fixed, observations, store, K, objective, solver)
        iterations += result.iterations
        bad = _misfits(result, max_error)
        dropped += int(bad.sum())
        _drop(views, observations, bad)
    kept = result.errors[~bad]
    return WindowReport(float(kept.mean()) if len(kept) else float("nan"), len(kept), dropped, iterations)


def _misfits(result: BundleResult, max_error: float) -> Mask:
    """Observations (O,) that the solution does not explain."""
    return (result.errors > max_error) | (result.depths <= 0.0)


def _gather(views: Sequence[View], free_count: int) -> _Observations:
    """Observations of the points that at least one free view and two views in all observe."""
    rows = [view.observed for view in views]
    camera = np.repeat(np.arange(len(views)), [len(r) for r in rows])
    row = np.concatenate(rows)
    point = np.concatenate([view.points[r] for view, r in zip(views, rows, strict=True)])
    if len(point) == 0:
        return _Observations(camera, row, point, point)
    oldest = int(point.min())  # counted from here, the cost does not grow with the points of the whole recording
    point = point - oldest
    size = int(point.max()) + 1
    times_seen = np.bincount(point, minlength=size)
    seen_free = np.bincount(point[camera < free_count], minlength=size)
    use = (times_seen >= 2) & (seen_free >= 1)
    kept = use[point]
    ids = np.flatnonzero(use)
    index = np.full(size, -1)
    index[ids] = np.arange(len(ids))
    return _Observations(camera[kept], row[kept], index[point[kept]], ids + oldest)


def _solve(
    views: Sequence[View],
    is_fixed: Mask,
    observations: _Observations,
    store: PointStore,
    K: Float64,
    objective: ObjectiveSettings,
    solver: SolverSettings,
) -> BundleResult:
    """Solve and write poses and points back."""
    ends = np.cumsum(np.bincount(observations.camera, minlength=len(views)))
    parts = np.split(observations.row, ends[:-1])
    result = solve(
        BundleProblem(
            cam_from_world=np.stack([view.cam_from_world for view in views if view.cam_from_world is not None]),
            points=store.xyz[observations.ids],
            camera_index=observations.camera,
            point_index=observations.point,
            keypoints=np.concatenate([view.keypoints[part] for view, part in zip(views, parts, strict=True)]),
            weights=np.concatenate([view.weights[part] for view, part in zip(views, parts, strict=True)]),
            K=K,
            fixed_cameras=is_fixed,
        ),
        objective,
        solver,
    )
    store.xyz[observations.ids] = result.points
    for i in np.flatnonzero(~is_fixed).tolist():
        views[i].cam_from_world = result.cam_from_world[i]
    return result


def _drop(views: Sequence[View], observations: _Observations, bad: Mask) -> None:
    for i in np.unique(observations.camera[bad]).tolist():
        views[i].points[observations.row[bad & (observations.camera == i)]] = NO_POINT
