"""The true trajectory beside the estimate, in the estimate's own world, where the recording has one."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from improvo.errors import InputError
from improvo.geometry.alignment import align_points
from improvo.odometry.run_folder import RunFolder
from improvo.types import Float64, Int64

_GAP = 10  # poses from one with truth to the next, which a line may bridge
_FEWEST = 3  # poses of a segment that an alignment needs


@dataclass(frozen=True)
class TruePath:
    """True camera centers, one row for each pose of the run, each segment aligned on its own (rotation, scale)."""

    centers: Float64  # (N, 3) in the world of the run, NaN where there is no truth
    ate_percent: float  # as `improvo evaluate trajectory` says it: in the unit of the truth, all segments together
    segment: Int64  # (N,) of each pose

    def drawn(self) -> Float64:
        """The centers (N, 3) as a line shows them: poses between two known ones nearby lie on the way.

        Truth that is slower than the pictures would otherwise be dots, of which a line shows nothing.
        """
        found = self.centers.copy()
        known = np.flatnonzero(np.isfinite(found).all(axis=1))
        for first, last in pairwise(known.tolist()):
            if 1 < last - first <= _GAP and self.segment[first] == self.segment[last]:
                share = np.linspace(0, 1, last - first + 1)[1:-1, None]
                found[first + 1 : last] = (1 - share) * found[first] + share * found[last]
        return found

    @property
    def text(self) -> str:
        """The error in words."""
        return f"{self.ate_percent:.2g} % of the path"


def true_path(run: RunFolder) -> TruePath | None:
    """The true path of a run; None where the recording has none, or is not there any more."""
    trajectory = run.trajectory
    try:
        truth = run.sequence.ground_truth
    except InputError:
        return None
    if truth is None or len(trajectory) == 0:
        return None
    rows = np.searchsorted(run.sequence.indices, np.array(run.source_index)[run.frame_indices])
    wanted = truth.camera_centers[np.minimum(rows, len(truth) - 1)]
    centers, squares, length = np.full_like(wanted, np.nan), [], 0.0
    known = np.isfinite(wanted).all(axis=1)
    for segment in np.unique(trajectory.segment).tolist():
        here = np.flatnonzero((trajectory.segment == segment) & known)
        estimate = trajectory.camera_centers[here]
        if len(here) < _FEWEST or np.ptp(wanted[here], axis=0).max() == 0 or np.ptp(estimate, axis=0).max() == 0:
            continue
        centers[here] = align_points(estimate, wanted[here], with_scale=True).apply(wanted[here])
        # segments have units of their own, the truth has one
        error = align_points(wanted[here], estimate, with_scale=True).apply(estimate) - wanted[here]
        squares.append((error**2).sum(axis=1))
        # from one known place to the next, also where there is no truth between them
        length += float(np.linalg.norm(np.diff(wanted[here], axis=0), axis=1).sum())
    if not squares or length == 0:
        return None
    rmse = float(np.sqrt(np.concatenate(squares).mean()))
    return TruePath(centers, 100.0 * rmse / length, trajectory.segment)
