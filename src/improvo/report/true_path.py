"""The true trajectory beside the estimate, in the estimate's own world, where the recording has one."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from improvo.errors import InputError
from improvo.evaluation.settings import TrajectorySettings
from improvo.evaluation.trajectory.protocol import aligned_segments, clean_truth, total_errors
from improvo.odometry.run.run_folder import RunFolder
from improvo.types import Float64, Int64, Trajectory

_GAP = 10  # poses from one with truth to the next, which a line may bridge


@dataclass(frozen=True)
class TruePath:
    """True camera centers, one row for each pose of the run.

    Each segment of the run is aligned with the truth on its own (Sim3), as `improvo evaluate trajectory` does, and the
    truth is carried back into the run's world by the inverse, so that both give the same figures.
    """

    centers: Float64  # (N, 3) in the world of the run, NaN where there is no truth
    ate_percent: float  # root mean square distance over the length of the true path
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
    wanted = truth.world_from_cam[np.minimum(rows, len(truth) - 1)]
    clean = clean_truth(Trajectory(trajectory.times, wanted))[0]
    if not (clean.valid.any() and trajectory.valid.any()):
        return None
    segments = aligned_segments(trajectory, clean, TrajectorySettings(time_windows=(), path_fractions=()))
    aligned = [each for each in segments if each.motion is not None and each.motion.scale > 0]
    total = total_errors(aligned)
    if total.ate_percent is None:
        return None
    centers = np.full((len(trajectory), 3), np.nan)
    for segment in aligned:
        assert segment.motion is not None
        centers[segment.rows] = segment.motion.inverse().apply(segment.truth[:, :3, 3])
    return TruePath(centers, total.ate_percent, trajectory.segment)
