"""Scale by a trajectory in metres: the recording's true poses, or a track of positions from elsewhere."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timezone

import numpy as np

from improvo.errors import InputError
from improvo.geometry.alignment import align_points
from improvo.geometry.position_track import (
    PositionTrack,
    is_position_track,
    read_position_track,
    time_in_seconds,
)
from improvo.geometry.trajectory_files import read_trajectory
from improvo.odometry.scale.estimate import ScaleEstimate, from_measurements
from improvo.odometry.scale.settings import ScaleSettings
from improvo.odometry.scale.tracked import TrackedRun
from improvo.sequences import Sequence
from improvo.sequences.association import nearest, poses_at
from improvo.types import Float64, Trajectory

_STRETCHES = 10  # of a segment, whose lengths are compared
_LEAST_MOVE = 0.1  # of the longest stretch; shorter ones say little
_FIRST_DATE = 6.3e8  # seconds; larger times are dates, smaller ones count from some start
_MOST_ERROR = 0.4  # of its own extent, after alignment, beyond which the two do not belong together


def reference_of(sequence: Sequence, settings: ScaleSettings) -> Trajectory:
    """The trajectory in metres, at the times of the sequence's frames, before any work.

    Of a GPS track only the places are known: each belongs to the frame nearest in time, and its rotation says nothing.

    Raises:
        InputError: there is none, or it has no pose at their times.
    """
    if settings.reference is None:
        truth = sequence.ground_truth
        if truth is None:
            raise InputError(
                f"--scale truth: {sequence.path} has no true poses; give a trajectory in metres or a GPS track "
                "(--scale truth FILE) or take another source"
            )
        name, span = str(sequence.path), ""
    else:
        name, times = settings.reference, sequence.times + _shift(settings.began)
        given, own = _of_file(name, times)
        truth = replace(given, times=sequence.times)
        span = f" (it lasts from {_when(own[0])} to {_when(own[-1])}, the recording from {_when(times[0])} to "
        span += f"{_when(times[-1])})"
    if truth.valid.sum() < 3:
        raise InputError(
            f"--scale truth: {name} has a place at the times of {int(truth.valid.sum())} frames, three are "
            f"needed{span}; bring both to one clock: --scale truth FILE BEGAN says when the recording began"
        )
    return truth


def _shift(began: str | None) -> float:
    """Seconds from the recording's clock to that of the reference."""
    shift = 0.0 if began is None else time_in_seconds(began)
    if not np.isfinite(shift):
        raise InputError(f"--scale truth: {began} is no time; give a date such as 2026-05-01T10:00:00Z, or seconds")
    return shift


def _of_file(name: str, times: Float64) -> tuple[Trajectory, Float64]:
    """The reference at some times, and its own times."""
    if is_position_track(name):
        track = read_position_track(name)
        return _at_frames(track, times), track.times
    try:
        given = read_trajectory(name)
    except InputError as error:
        raise InputError(f"{error}, or a GPS track (GPX, or a table with latitude and longitude)") from None
    return poses_at(given, times), given.times


def _at_frames(track: PositionTrack, times: Float64) -> Trajectory:
    """The places of a track, each at the frame nearest to it in time; other frames have none."""
    step = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    frame = nearest(track.times, times, 0.5 * step + 1e-6)
    poses = np.full((len(times), 4, 4), np.nan)
    known = frame >= 0
    poses[frame[known]] = np.eye(4)
    poses[frame[known], :3, 3] = track.xyz[known]
    return Trajectory(times, poses, np.where(np.isfinite(poses[:, 0, 3]), 0, -1))


def _when(seconds: float) -> str:
    """A time for a person: a date where it is one."""
    if seconds < _FIRST_DATE:
        return f"{seconds:.1f} s"
    return datetime.fromtimestamp(seconds, timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ")


def scale_from_truth(run: TrackedRun, reference: Trajectory) -> dict[int, ScaleEstimate]:
    """By segment, where it has three frames with a true pose and moves.

    Raises:
        InputError: no segment has, or the trajectories do not fit each other.
    """
    rows = np.array([run.row(frame) for frame in range(len(run.trajectory))], np.int64)
    metric = np.where(reference.valid[rows, None], reference.camera_centers[rows], np.nan)
    found = {}
    for segment in run.segments:
        frames = run.frames(segment)
        frames = frames[np.isfinite(metric[frames]).all(axis=1)]
        own, given = run.trajectory.camera_centers[frames], metric[frames]
        if len(frames) < 3 or not _moves(own) or not _moves(given):
            continue
        motion = align_points(given, own, with_scale=True)
        error, extent = _rms(motion.apply(own) - given), _rms(given - given.mean(axis=0))
        if motion.scale <= 0 or error > _MOST_ERROR * extent:
            raise InputError(
                f"--scale truth: does not fit the run, {error:.3g} m off where it spreads over {extent:.3g} m; are "
                "they of one recording, and on one clock?"
            )
        stretches = _stretches(own, given)
        if len(stretches[0]) < 3:
            found[segment] = ScaleEstimate(motion.scale, None, len(frames))
            continue
        spread = from_measurements(*stretches)
        found[segment] = replace(spread, metres_per_unit=motion.scale, measurements=len(frames))
    if not found:
        raise InputError(
            "--scale truth: no segment of the run moves and has three frames with a true pose; take another source"
        )
    return found


def _rms(offsets: Float64) -> float:
    return float(np.sqrt(np.mean(np.sum(offsets**2, axis=1))))


def _moves(centres: Float64) -> bool:
    return bool(np.ptp(centres, axis=0).max() > 1e-9)


def _stretches(own: Float64, given: Float64) -> tuple[Float64, Float64]:
    """Ratios (K,) of the distances between frames some way apart, and where they begin (K,)."""
    step = max(1, len(own) // _STRETCHES)
    mine, theirs = (np.linalg.norm(centres[step:] - centres[:-step], axis=1) for centres in (own, given))
    far = mine > _LEAST_MOVE * mine.max()
    return theirs[far] / mine[far], np.flatnonzero(far).astype(np.float64)
