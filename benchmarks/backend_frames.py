"""One new frame after another: the paper's procedure with Ceres against ours, from the same first window."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from backend_windows import Recording, triangulate
from improvo.backend import BundleProblem, BundleResult, SolverSettings, solve
from improvo.geometry import se3
from improvo.geometry.alignment import align_points
from improvo.geometry.camera import Camera
from improvo.geometry.ransac import Ransac, absolute_pose
from improvo.geometry.triangulation import triangulate_tracks
from improvo.types import Float64, Int64

WINDOW = 30  # poses that are optimised (paper, N_last)
MAX_ERROR = 3.0  # pixels, over which our procedure drops an observation
OURS = SolverSettings(relative_decrease=1e-3)


class _Stopwatch:
    """Processor time of this thread inside its `with` blocks."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __enter__(self) -> None:
        self._start = time.thread_time()

    def __exit__(self, *_: object) -> None:
        self.seconds += time.thread_time() - self._start


@dataclass
class State:
    """What is known so far; a track without a point is NaN."""

    recording: Recording
    cam_from_world: Float64  # (N, 4, 4) valid up to the present frame
    points: Float64  # (T, 3)
    dropped: np.ndarray  # (O,) observations that our procedure has taken out
    seconds: list[float] = field(default_factory=list)  # processor time per frame
    iterations: list[int] = field(default_factory=list)

    def rows(self, first: int, last: int) -> Int64:
        """Observations of frames first ... last of tracks that have a point."""
        recording = self.recording
        inside = (recording.camera_index >= first) & (recording.camera_index <= last) & ~self.dropped
        return np.flatnonzero(inside & np.isfinite(self.points[recording.track, 0]))


def first_window(recording: Recording) -> State:
    """The first frames at their optimum, found from the truth, for both procedures alike."""
    early = recording.camera_index < WINDOW
    some = triangulate(replace(recording, cam_from_world=_without_poses_after(recording.cam_from_world, WINDOW)))
    points = np.where(some.ok[:, None], some.points, np.nan)
    dropped = early & (np.nan_to_num(some.errors, nan=0.0) > 4 * MAX_ERROR)
    state = State(recording, recording.cam_from_world.copy(), points, dropped)
    settings = SolverSettings(relative_decrease=1e-8)
    _write_back(state, *_solve_window(state, 0, WINDOW - 1, 1, lambda p: solve(p, settings=settings)))
    return state


def slide(state: State, frames: range, step: Callable[[State, int], None]) -> State:
    """A copy of the state after one procedure has dealt with these frames."""
    state = replace(
        state,
        cam_from_world=state.cam_from_world.copy(),
        points=state.points.copy(),
        dropped=state.dropped.copy(),
        seconds=[],
        iterations=[],
    )
    for frame in frames:
        step(state, frame)
    return state


def ours(state: State, frame: int) -> None:
    """Pose by RANSAC on the known points, new points triangulated, 30 older poses as constants, stop at 1e-3.

    The time is that of these calls; looking up which observations they take is the benchmark's own.
    """
    watch = _Stopwatch()
    state.cam_from_world[frame] = _absolute_pose(state, frame, watch)
    recording = state.recording
    missing = np.isnan(state.points[:, 0])
    rows = np.flatnonzero(missing[recording.track] & (recording.camera_index <= frame) & ~state.dropped)
    if len(rows):
        part = recording.take(rows)
        offsets = part.offsets()
        with watch:
            found = triangulate_tracks(
                part.keypoints, part.camera_index, offsets, state.cam_from_world[: frame + 1], part.K
            )
        state.points[np.unique(recording.track[rows])[found.ok]] = found.points[found.ok]
    first = max(frame - WINDOW + 1, 0)
    oldest = max(first - WINDOW, 0)
    iterations = 0

    def solver(problem: BundleProblem) -> BundleResult:
        with watch:
            return solve(problem, settings=OURS)

    for _ in range(2):
        rows, fixed, result = _solve_window(state, oldest, frame, first - oldest, solver)
        _write_back(state, rows, fixed, result)
        iterations += result.iterations
        bad = rows[(result.errors > MAX_ERROR) | (result.depths <= 0)]
        state.dropped[bad] = True
        if not len(bad):
            break
    state.seconds.append(watch.seconds)
    state.iterations.append(iterations)


def paper(solve_with_ceres: Callable[[BundleProblem], object]) -> Callable[[State, int], None]:
    """The previous pose, unit depth, all 30 poses free but the oldest, Ceres to its default tolerance."""

    def step(state: State, frame: int) -> None:
        recording = state.recording
        state.cam_from_world[frame] = state.cam_from_world[frame - 1]
        rows = np.flatnonzero((recording.camera_index == frame) & np.isnan(state.points[recording.track, 0]))
        rays = (recording.keypoints[rows] - recording.K[:2, 2]) / recording.K[[0, 1], [0, 1]]
        at_unit_depth = np.column_stack([rays, np.ones(len(rows))])
        state.points[recording.track[rows]] = se3.transform(se3.inverse(state.cam_from_world[frame]), at_unit_depth)
        first = max(frame - WINDOW + 1, 0)
        rows, fixed, result = _solve_window(state, first, frame, 1, solve_with_ceres)
        _write_back(state, rows, fixed, result)
        state.seconds.append(result.seconds)
        state.iterations.append(result.iterations)

    return step


def position_error(state: State, frames: range) -> float:
    """Root mean square position error of these frames after a similarity, % of the path."""
    chosen = list(frames)
    truth = se3.inverse(state.recording.cam_from_world)[chosen, :3, 3]
    estimate = se3.inverse(state.cam_from_world)[chosen, :3, 3]
    offsets = align_points(truth, estimate, with_scale=True).apply(estimate) - truth
    path = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    return float(100 * np.sqrt((offsets**2).sum(axis=1).mean()) / path)


def _without_poses_after(cam_from_world: Float64, count: int) -> Float64:
    return np.where(np.arange(len(cam_from_world))[:, None, None] < count, cam_from_world, np.nan)


def _absolute_pose(state: State, frame: int, watch: _Stopwatch) -> Float64:
    recording = state.recording
    rows = np.flatnonzero((recording.camera_index == frame) & np.isfinite(state.points[recording.track, 0]))
    K = recording.K
    camera = Camera(int(2 * K[0, 2] + 1), int(2 * K[1, 2] + 1), K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    ransac = Ransac(2 * MAX_ERROR, seed=frame, min_iterations=50)
    points = state.points[recording.track[rows]]
    keypoints = recording.keypoints[rows]
    with watch:
        found = absolute_pose(points, keypoints, camera, ransac)
    return found.pose


def _solve_window(
    state: State, first: int, last: int, constant: int, solver: Callable[[BundleProblem], object]
) -> tuple[Int64, np.ndarray, BundleResult]:
    recording = state.recording
    rows = state.rows(first, last)
    _, track = np.unique(recording.track[rows], return_inverse=True)
    rows = rows[(np.bincount(track) >= 2)[track]]
    ids, track = np.unique(recording.track[rows], return_inverse=True)
    fixed = np.arange(last - first + 1) < constant
    problem = BundleProblem(
        cam_from_world=state.cam_from_world[first : last + 1],
        points=state.points[ids],
        camera_index=recording.camera_index[rows] - first,
        point_index=track,
        keypoints=recording.keypoints[rows],
        weights=np.ones(len(rows)),
        K=recording.K,
        fixed_cameras=fixed,
    )
    return rows, np.arange(first, last + 1), solver(problem)


def _write_back(state: State, rows: Int64, frames: Int64, result: BundleResult) -> None:
    state.cam_from_world[frames] = result.cam_from_world
    state.points[np.unique(state.recording.track[rows])] = result.points
