"""Joining a new map with that of a segment that ended before, where the camera sees the same place again.

Two views of the new map must find the former one, and agree on where it lies and how large it is, and the camera must
have been able to come from there to here. The newest two that do so count, as long as nothing is final. Otherwise two
segments with scales of their own stand side by side, placed by guess.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from improvo.geometry import se3
from improvo.geometry.alignment import Similarity
from improvo.odometry.gates import SAME_SCALE, SAME_TURN_DEG
from improvo.odometry.mapping.camera_path import CameraPath
from improvo.odometry.mapping.former_map import FormerMap, Sighting
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.view import View
from improvo.types import Float64

_FORMER_MAPS = 2  # kept; the camera seldom returns to an older place within so few frames


@dataclass(frozen=True)
class Join:
    """Where the running map lies in a former one."""

    number: int  # of the former segment
    shared_from_new: Similarity  # from the running map's own world to the one that all segments are placed in
    scale_error: float  # relative
    points: int  # of the former map, found by the view that decided


class Bridging:
    """Looks for the former maps in the views of a new one.

    Args:
        settings: of the odometry; `bridging` says how long, `verdict.max_error` and `start.min_points` how sure.
    """

    def __init__(self, settings: OdometrySettings) -> None:
        self._max_frames = settings.bridging.max_frames
        self._max_error = settings.verdict.max_error / 100.0  # of the scale, and of places as a share of their distance
        self._min_points = settings.start.min_points
        self._former: list[FormerMap] = []
        self._sightings: dict[int, list[Sighting]] = {}  # by row of the former map
        self._join: Join | None = None  # of the running map,
        self._joined_map: FormerMap | None = None  # with this one,
        self._last: Sighting | None = None  # which this one was the last to see

    def remember(self, former: FormerMap) -> None:
        """A segment has ended; where it went on with a former one, both maps are kept."""
        self._former = [*self._former, former][-_FORMER_MAPS:]
        self._sightings = {}

    def new_map(self) -> None:
        """What was seen from another map does not count any more."""
        self._sightings, self._join, self._joined_map, self._last = {}, None, None, None

    def look(self, view: View, xyz: Float64, running: Sequence[View]) -> Join | None:
        """The join that this view decides, if it and another one agree; or what it changes of the one that there is.

        Args:
            view: of the running map, with a pose.
            xyz: (P, 3) points of the running map.
            running: its views from the first one on.
        """
        if self._join is not None:
            return self._look_again(view, xyz, running)
        oldest = view.frame_index - self._max_frames
        for row, former in enumerate(self._former):
            if former.last_frame < oldest:
                continue
            sighting = former.sighting(view, xyz)
            if sighting is None:
                continue
            for other in self._sightings.get(row, []):
                join = self._believed(former, other, sighting, running)
                if join is not None:
                    self._join, self._joined_map, self._last = join, former, sighting
                    return join
            self._sightings.setdefault(row, []).append(sighting)
        return None

    def _look_again(self, view: View, xyz: Float64, running: Sequence[View]) -> Join | None:
        """The join by the newest two sightings; None where this view does not see the former map.

        The depths of a map that has just started are poorly known, all together, so that its scale can change by a
        factor of two while the camera moves on. Where the two do not agree, the scale is known no better than the
        newest one differs from that of the join.
        """
        assert self._join is not None
        assert self._joined_map is not None
        assert self._last is not None
        former, before = self._joined_map, self._last
        sighting = former.sighting(view, xyz)
        if sighting is None:
            return None
        self._last = sighting
        join = self._believed(former, before, sighting, running)
        if join is None:
            now = former.shared_from_own.scale * sighting.former_from_new.scale
            change = abs(float(np.log(now / self._join.shared_from_new.scale))) - 3.0 * sighting.scale_error
            join = replace(self._join, scale_error=max(self._join.scale_error, change))
        self._join = join
        return join

    def _believed(self, former: FormerMap, a: Sighting, b: Sighting, running: Sequence[View]) -> Join | None:
        """The join by two sightings; None where they contradict each other or the camera's path."""
        join = _joined(former, a, b, self._max_error)
        if join is None or join.points < self._min_points:  # a place that looks alike has a few points, too
            return None
        if join.scale_error > self._max_error:
            return None
        here = CameraPath.of(running).placed(join.shared_from_new)
        # where texture repeats, a place one repetition off looks the same, in every view
        slack = self._max_error * b.depth * former.shared_from_own.scale
        return None if here.is_leap_from(former.camera_path, slack=slack) else join


def _joined(former: FormerMap, a: Sighting, b: Sighting, max_error: float) -> Join | None:
    """Both sightings as one; None where they contradict each other."""
    errors = np.maximum([a.scale_error, b.scale_error], 1e-4)
    logs = np.log([a.former_from_new.scale, b.former_from_new.scale])
    change = float(abs(logs[1] - logs[0]))
    if change > SAME_SCALE + 3.0 * float(np.hypot(*errors)):
        return None
    angle = se3.rotation_angle_deg(a.former_from_new.rotation.T @ b.former_from_new.rotation)
    distance = np.linalg.norm(a.former_from_new.apply(b.center) - b.former_pose[:3, 3])
    if float(angle) > SAME_TURN_DEG or distance > max_error * b.depth:
        return None
    log_scale = float(np.average(logs, weights=errors**-2.0))
    better = a if a.inliers >= b.inliers else b
    scale, rotation = float(np.exp(log_scale)), better.former_from_new.rotation
    here, there = 0.5 * (a.center + b.center), 0.5 * (a.former_pose[:3, 3] + b.former_pose[:3, 3])
    return Join(
        number=former.number,
        shared_from_new=former.shared_from_own.after(Similarity(scale, rotation, there - scale * rotation @ here)),
        scale_error=max(float((errors**-2.0).sum() ** -0.5), 0.5 * change),
        points=better.inliers,
    )
