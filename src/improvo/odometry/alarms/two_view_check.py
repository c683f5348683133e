"""Is the map right? An independent check against fresh two-view geometry.

A wrong map can fit its own tracks well, because observations that do not fit are dropped. The essential matrix of two
views that are matched afresh does not depend on the map. If many matches support it and they do not fit the map's
relative pose, the map is wrong.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.geometry.epipolar import sampson_errors
from improvo.geometry.ransac import Ransac, relative_pose
from improvo.odometry.gates import FEATURES, LARGE_PART, SAME_TURN_DEG, STEP_FRAMES
from improvo.odometry.mapping.two_motions import holds_beside
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.view import View, ransac_pairs
from improvo.tracking.matching import match_units
from improvo.types import Int64

_GAPS = (3, 6, 12)  # frames between the two views of a check
_ROUNDS = 3  # consecutive checks that are evaluated together
_AGREEMENT = 0.85  # share of the two views' own inliers that fit the map: right maps stay over 0.90, wrong under 0.80
_TRACKED_AGREEMENT = 0.95  # of those that are tracked, too: so many speak for the map, whatever the others agree on


@dataclass(frozen=True)
class Agreement:
    """Matches of two views that fit the map's relative pose, against those that fit their own essential matrix."""

    map_inliers: int
    own_inliers: int
    matches: int
    turn_deg: float = 0.0  # between the rotations of both poses
    two_motions: bool = False  # each is supported by matches that are far off the other; the check decides nothing
    # Of the inliers, those whose track leads from the one view to the other, frame by frame.
    map_tracked: int = 0
    own_tracked: int = 0


class TwoViewCheck:
    """Compares the map with two-view geometry every few frames.

    On five real sequences with three frontends a right map keeps at least 90 % of the two views' own inliers over
    three checks; a mirrored or otherwise wrong one keeps at most 80 % (docs/log-odometry.md).

    Args:
        camera: pinhole camera of the views.
        settings: of the odometry; `ransac_gate`, `start`, `tolerance` and `seed` are used.
        descriptor_distance: the matching threshold on unit descriptors.
    """

    def __init__(self, camera: Camera, settings: OdometrySettings, descriptor_distance: float) -> None:
        self._camera = camera
        self._settings = settings
        self._descriptor_distance = descriptor_distance
        self._rounds: deque[Int64] = deque(maxlen=_ROUNDS)  # of (gaps, 4) map and own inliers, all and tracked
        self._two_motions = 0  # checks in a row that saw two
        self._has_judged = False

    def contradicts(self, view: View, earlier: Mapping[int, View]) -> bool:
        """Whether the last checks together say that the map is wrong.

        Args:
            view: the newest view with a pose.
            earlier: recent views with poses by frame index.
        """
        if view.frame_index % STEP_FRAMES:
            return False
        counts = np.zeros((len(_GAPS), 4), np.int64)
        two_motions = False
        for row, gap in enumerate(_GAPS):
            if view.frame_index - gap not in earlier:
                continue
            found = agreement(
                earlier[view.frame_index - gap], view, self._camera, self._descriptor_distance, self._settings
            )
            two_motions |= found.two_motions
            if found.two_motions or not self._credible(found):
                continue
            counts[row] = found.map_inliers, found.own_inliers, found.map_tracked, found.own_tracked
        self._rounds.append(counts)
        self._two_motions = self._two_motions + 1 if two_motions else 0
        if len(self._rounds) < _ROUNDS:
            return False
        self._has_judged = True
        map_inliers, own_inliers, map_tracked, own_tracked = np.sum(self._rounds, axis=(0, 1))
        decides = own_inliers >= _ROUNDS * self._settings.start.min_points
        # A wall of repeated texture, matched one repetition off, moves rigidly, too; tracks seldom make that mistake.
        confirmed = map_tracked >= max(self._settings.start.min_points, _TRACKED_AGREEMENT * own_tracked)
        return bool(decides and map_inliers < _AGREEMENT * own_inliers and not confirmed)

    def _credible(self, found: Agreement) -> bool:
        """Whether enough matches agree with the two views' own pose for it to say something of the map.

        One that turned far otherwise comes from repeated texture or a crowd more often than from a wrong map. It
        counts where most matches agree with it, and tracks do, too, rather than with the map.
        """
        least = self._settings.start.min_points
        if found.turn_deg < SAME_TURN_DEG:
            return found.own_inliers >= max(least, LARGE_PART * found.matches)
        most = found.own_inliers >= (1.0 - LARGE_PART) * found.matches
        return most and found.own_tracked >= least and found.map_tracked < _AGREEMENT * found.own_tracked

    @property
    def has_judged(self) -> bool:
        """Whether there were checks enough to say that a map is wrong."""
        return self._has_judged

    def start_over(self) -> None:
        """What the last checks said was looked into, and counts no more."""
        self._rounds.clear()

    @property
    def ambiguous(self) -> bool:
        """Whether the last checks saw another motion beside the map's, so that one of both is not the camera's."""
        return self._two_motions >= _ROUNDS - 1


def agreement(a: View, b: View, camera: Camera, descriptor_distance: float, settings: OdometrySettings) -> Agreement:
    """Match two views with poses afresh, and count the matches that fit each of the two relative poses.

    Only matches that pass the RANSAC gate are sampled, so that a crowd's motion is not taken for the camera's. All
    matches are counted, since those that pass the gate can be too few to show that a map is wrong.

    Args:
        a: the earlier view.
        b: the later view.
        camera: pinhole, of both.
        descriptor_distance: the matching threshold on unit descriptors.
        settings: of the odometry.
    """
    assert a.cam_from_world is not None
    assert b.cam_from_world is not None
    rows_a, rows_b = (np.flatnonzero(~view.attached)[:FEATURES] for view in (a, b))
    matches = match_units(a.descriptors[rows_a], b.descriptors[rows_b], descriptor_distance)
    matches = np.stack([rows_a[matches[:, 0]], rows_b[matches[:, 1]]], axis=1)
    if len(matches) < 8:
        return Agreement(0, 0, len(matches))
    pixels_a, pixels_b = a.keypoints[matches[:, 0]], b.keypoints[matches[:, 1]]
    used = ransac_pairs(a, b, matches, settings)
    limit = settings.tolerance
    ransac = Ransac(limit, settings.seed, min_iterations=100, max_iterations=1000)
    own = relative_pose(pixels_a[used], pixels_b[used], camera, ransac)
    of_map = b.cam_from_world @ se3.inverse(a.cam_from_world)
    map_errors, own_errors = (sampson_errors(b_from_a, camera, pixels_a, pixels_b) for b_from_a in (of_map, own.pose))
    fits_own = own_errors < limit
    fits_own[used] = own.inliers  # which also lie in front of both
    two_motions = holds_beside(map_errors, own_errors, pixels_b, camera, limit)
    turn = float(se3.rotation_angle_deg((of_map[:3, :3].T @ own.pose[:3, :3])[None])[0])
    fits_map = map_errors < limit
    tracked = a.tracks[matches[:, 0]] == b.tracks[matches[:, 1]]
    counts = (int(each.sum()) for each in (fits_map & tracked, fits_own & tracked))
    return Agreement(int(fits_map.sum()), int(fits_own.sum()), len(matches), turn, two_motions, *counts)
