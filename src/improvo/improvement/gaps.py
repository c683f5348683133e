"""How far apart the two frames of a pair are, by how the camera moves: by overlap, whatever the frame rate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from improvo.evaluation.pose.self_truth import FixedRun, choose_pairs
from improvo.geometry import se3

_PAIRS = 12  # at which overlap is measured, for each gap
_EVERY = 8  # pixels of a depth map between those that are looked at


def choose_gaps(run: FixedRun, overlaps: Sequence[float], min_pairs: int) -> tuple[int, ...]:
    """Gaps in frames, increasing: at each, a frame shows about so much of the other.

    Args:
        run: the frames.
        overlaps: shares, the largest first.
        min_pairs: that a gap must have; wider ones are not taken.

    Returns:
        As many gaps as shares, or fewer where the run is too short for different ones; empty without any pair.
    """
    possible = [gap for gap in _series(len(run.segment)) if len(choose_pairs(run, gap, min_pairs)) >= min_pairs]
    if not possible:
        return ()
    shown = np.array([median_overlap(run, gap) for gap in possible])
    gaps: list[int] = []
    for level, share in enumerate(overlaps):
        below = np.flatnonzero(shown < share)
        # the last gap before the overlap falls under the share; else evenly up to the longest
        fallback = (len(possible) * (level + 1)) // len(overlaps) - 1
        row = max(int(below[0]) - 1, 0) if len(below) else max(fallback, 0)
        while row < len(possible) - 1 and gaps and possible[row] <= gaps[-1]:
            row += 1
        if not gaps or possible[row] > gaps[-1]:
            gaps.append(possible[row])
    return tuple(gaps)


def median_overlap(run: FixedRun, gap: int) -> float:
    """Share of what a frame shows that lies within the frame `gap` later, the median of some pairs."""
    return float(np.median([_overlap(run, int(a), int(b)) for a, b in choose_pairs(run, gap, _PAIRS)]))


def _overlap(run: FixedRun, a: int, b: int) -> float:
    depth = run.depth(a)[_EVERY // 2 :: _EVERY, _EVERY // 2 :: _EVERY].astype(np.float64)
    height, width = run.depth(a).shape
    rows, columns = np.nonzero(depth > 0)
    if len(rows) == 0:
        return 0.0
    scale = np.array([run.camera.width / width, run.camera.height / height])
    places = (np.stack([columns, rows], axis=1) * _EVERY + _EVERY // 2 + 0.5) * scale - 0.5
    points = run.camera.unproject(places, depth[rows, columns])
    seen = se3.transform(se3.inverse(run.world_from_cam[b]) @ run.world_from_cam[a], points)
    ahead = seen[:, 2] > 1e-6
    pixels = run.camera.project(np.where(ahead[:, None], seen, [0.0, 0.0, 1.0]))
    inside = (pixels >= 0).all(axis=1) & (pixels <= (run.camera.width - 1, run.camera.height - 1)).all(axis=1)
    return float((ahead & inside).mean())


def _series(frames: int) -> list[int]:
    """1, 2, 3, ... then in steps of about a tenth."""
    series, gap = [], 1
    while gap < frames:
        series.append(gap)
        gap += max(1, gap // 10)
    return series
