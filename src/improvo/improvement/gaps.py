"""How far apart the two frames of a pair are, by how the camera moves: by overlap, whatever the frame rate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from improvo.evaluation.pose.gaps import overlap, series
from improvo.evaluation.pose.self_truth import FixedRun, choose_pairs
from improvo.geometry import se3

_PAIRS = 12  # at which overlap is measured, for each gap


def choose_gaps(run: FixedRun, overlaps: Sequence[float], min_pairs: int) -> tuple[int, ...]:
    """Gaps in frames, increasing: at each, a frame shows about so much of the other.

    Args:
        run: the frames.
        overlaps: shares, the largest first.
        min_pairs: that a gap must have; wider ones are not taken.

    Returns:
        As many gaps as shares, or fewer where the run is too short for different ones; empty without any pair.
    """
    possible = [gap for gap in series(len(run.segment)) if len(choose_pairs(run, gap, min_pairs)) >= min_pairs]
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
    shares = []
    for a, b in choose_pairs(run, gap, _PAIRS).tolist():
        b_from_a = se3.inverse(run.world_from_cam[b]) @ run.world_from_cam[a]
        shares.append(overlap(run.camera, run.depth(a), b_from_a))
    return float(np.median(shares))
