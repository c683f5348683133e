"""Scale by depth images: each frame's median ratio of measured depth to the depth of the run's own points."""

from __future__ import annotations

import numpy as np

from improvo.errors import InputError
from improvo.geometry import se3
from improvo.geometry.depth_sampling import depth_at
from improvo.odometry.scale.estimate import ScaleEstimate, from_measurements, robust_spread
from improvo.odometry.scale.tracked import TrackedRun
from improvo.sequences import Sequence

_LEAST_POINTS = 12  # of a frame
_MOST_FRAMES = 300  # of a segment whose depth is read
_PROBES = 40  # frames in which depth is looked for before the run
_MOST_SPREAD = 0.3  # between frames, beyond which depth and run do not belong together


def check_depth(sequence: Sequence) -> None:
    """Refuse a recording without depth, before any work.

    Raises:
        InputError: none of many frames has any.
    """
    rows = np.unique(np.linspace(0, len(sequence) - 1, min(_PROBES, len(sequence))).astype(int))
    # neighbours too: some recordings have depth for every second frame
    for row in rows.tolist():
        for near in (row, min(row + 1, len(sequence) - 1)):
            depth = sequence.depth(near)
            if depth is not None and np.isfinite(depth).any():
                return
    raise InputError(
        f"--scale depth: {sequence.path} has no depth images; take another source "
        "(truth, distance A B METRES, height METRES, marker METRES)"
    )


def scale_from_depth(run: TrackedRun) -> dict[int, ScaleEstimate]:
    """By segment, where it has frames with enough points of known depth.

    Raises:
        InputError: no segment has, or the depth images contradict the run.
    """
    found = {}
    for segment in run.segments:
        frames = run.frames(segment)
        counts = np.searchsorted(run.known.frame, frames + 1) - np.searchsorted(run.known.frame, frames)
        frames = frames[counts >= _LEAST_POINTS]
        chosen, medians = [], []
        for frame in _with_depth(run, frames):
            ratio = _ratios(run, frame)
            if len(ratio) >= _LEAST_POINTS:
                chosen.append(frame)
                medians.append(float(np.median(ratio)))
        if not medians:
            continue
        factors = np.array(medians)
        spread = robust_spread(factors) / float(np.median(factors))
        if spread > _MOST_SPREAD:
            raise InputError(
                f"--scale depth: contradicts itself, the scale of single frames differs by {100 * spread:.0f} %; is "
                "the depth registered to the images, and its unit right (`improvo info`)?"
            )
        found[segment] = from_measurements(factors, np.array(chosen, np.float64))
    if not found:
        raise InputError("--scale depth: no frame has enough points with depth; take another source")
    return found


def _with_depth(run: TrackedRun, frames: np.ndarray) -> list[int]:
    """Frames that have depth, thinned out evenly where they are many."""
    step = max(1, len(frames) // _MOST_FRAMES)
    chosen = []
    for start in range(0, len(frames), step):
        # every second frame may lack depth: one of two neighbours will do
        for frame in frames[start : start + min(step, 2)].tolist():
            if run.sequence.depth(run.row(frame)) is not None:
                chosen.append(frame)
                break
    return chosen


def _ratios(run: TrackedRun, frame: int) -> np.ndarray:
    """Measured depth over the run's, of the points that a frame sees."""
    depth = run.sequence.depth(run.row(frame))
    if depth is None:
        return np.zeros(0)
    rows = run.seen_by(frame)
    own = se3.transform(run.cam_from_world[frame], run.known.xyz[rows])[:, 2]
    measured = depth_at(run.known.keypoints[rows], depth)
    good = np.isfinite(measured) & (own > 0)
    return np.asarray(measured[good] / own[good])
