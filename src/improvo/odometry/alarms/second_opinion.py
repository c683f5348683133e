"""A second opinion on a map that was contradicted: does a map started anew over the same frames say otherwise?

Two views, and what is known of the picture, can be led astray: by a crowd that moves together, by texture that repeats,
by noise. What decides is the evidence that neither map was chosen by: the tracks of all frames. A track that three or
more views saw fits the poses of a right map, with one point, in each of them. A map is wrong if poses that start anew
explain clearly more tracks; it is not if they explain no more, or if they are the same poses but for the scale.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.geometry.triangulation import triangulate_tracks
from improvo.odometry.gates import SAME_PATH, SAME_TURN_DEG
from improvo.odometry.mapping.initial_pair import InitFailure
from improvo.odometry.mapping.start import start_map
from improvo.odometry.result.events import EventLog
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.verdict.path_error import error_percent
from improvo.odometry.view import View
from improvo.types import Float64

Poses = Mapping[int, Float64]  # cam_from_world (4, 4) by frame index

_LEAST_VIEWS = 3  # of a track: two views fit a point of their own under nearly any poses
_BETTER = 1.1  # times as many tracks: less is chance (docs/log-odometry.md)


@dataclass(frozen=True)
class _Dropped:
    """A map that was given up."""

    frame_index: int  # at which
    by: str  # why
    poses: Poses
    poses_contradicted: bool


class SecondOpinion:
    """Asks a second map where something speaks against the first, and tells what it says.

    Args:
        camera: pinhole camera of the views.
        settings: of the odometry.
        descriptor_distance: the matching threshold on unit descriptors.
        events: are told.
    """

    def __init__(
        self, camera: Camera, settings: OdometrySettings, descriptor_distance: float, events: EventLog
    ) -> None:
        self._camera = camera
        self._settings = settings
        self._descriptor_distance = descriptor_distance
        self._events = events
        self._dropped: _Dropped | None = None
        self.undecided = False  # whether the last map that stays does so because the second had two motions

    def stands(self, views: Sequence[View], by: str) -> bool:
        """Whether a map that was contradicted stays, since one started anew explains the tracks no better.

        It stays undecided, too, where the second could choose between two motions: so could the two views.

        Args:
            views: in temporal order, with the poses of the map; they stay as they are.
            by: what contradicted it.
        """
        self.undecided = False
        copies = [view.unposed() for view in views]
        started = start_map(copies, self._camera, self._settings, self._descriptor_distance)
        if isinstance(started, InitFailure):
            if not started.undecided:
                return False
            self.undecided = True
            found = "has two motions to choose from, so it stays"  # as the two views had that spoke against it
            self._events.checked_again(views[-1].frame_index, by, found)
            return True
        former, anew = _poses_of(views), _poses_of(copies)
        if self._better([view for view in views if view.frame_index in anew], former, anew):
            return False
        self._events.checked_again(views[-1].frame_index, by, "explains no more of the tracks, so it stays")
        return True

    def drop(self, views: Sequence[View], by: str, *, poses_contradicted: bool) -> None:
        """A provisional map is started anew over its views; it may have been right all the same.

        Args:
            views: in temporal order, with the poses of the map.
            by: what spoke against it.
            poses_contradicted: whether that said something of its poses; what moves with the camera only tells that
                many of its points are none of the world.
        """
        self._dropped = _Dropped(views[-1].frame_index, by, _poses_of(views), poses_contradicted)

    def on_dropped(self, views: Sequence[View]) -> bool:
        """The next map has started, or there is none; now it is told whether the one that was dropped was wrong.

        Args:
            views: of the next map.

        Returns:
            Whether it was not: the next one has its poses, or, if nothing contradicted those, explains no more of the
            tracks of the same frames.
        """
        if self._dropped is None:
            return False
        dropped, anew = self._dropped, _poses_of(views)
        self._dropped = None
        if same_poses(dropped.poses, anew, self._settings.verdict.max_error):
            self._events.checked_again(dropped.frame_index, dropped.by, "has the same poses")
            return True
        common = [view for view in views if view.frame_index in dropped.poses and view.frame_index in anew]
        if (
            not dropped.poses_contradicted
            and len(common) >= _LEAST_VIEWS
            and not self._better(common, dropped.poses, anew)
        ):
            self._events.checked_again(dropped.frame_index, dropped.by, "explains no more of the tracks")
            return True
        self._events.contradicted(dropped.frame_index, "the map is started anew", dropped.by)
        return False

    def _better(self, views: Sequence[View], former: Poses, anew: Poses) -> bool:
        """Whether the second poses explain clearly more tracks of the views than the first."""
        tracks, tracks_anew = (
            explained_tracks(views, poses, self._camera, self._settings.tolerance) for poses in (former, anew)
        )
        return tracks_anew > _BETTER * tracks


def _poses_of(views: Sequence[View]) -> dict[int, Float64]:
    """Poses by frame index, of the views that have one."""
    return {view.frame_index: view.cam_from_world.copy() for view in views if view.cam_from_world is not None}


def explained_tracks(views: Sequence[View], poses: Poses, camera: Camera, tolerance: float) -> int:
    """Tracks of three or more views that one point in front of all of them explains in each.

    Args:
        views: keypoints as detected and tracks are used; what moves with the camera is left out.
        poses: of all of them.
        camera: pinhole.
        tolerance: pixels, in every view.
    """
    if len(views) < _LEAST_VIEWS:
        return 0
    worlds = [np.flatnonzero(~view.attached) for view in views]
    tracks = np.concatenate([view.tracks[rows] for view, rows in zip(views, worlds, strict=True)])
    keypoints = np.concatenate([view.detected[rows] for view, rows in zip(views, worlds, strict=True)])
    camera_index = np.repeat(np.arange(len(views)), [len(rows) for rows in worlds])
    order = np.lexsort((camera_index, tracks))
    _, inverse, counts = np.unique(tracks[order], return_inverse=True, return_counts=True)
    order = order[counts[inverse] >= _LEAST_VIEWS]
    if len(order) == 0:
        return 0
    _, first = np.unique(tracks[order], return_index=True)
    offsets = np.append(first, len(order)).astype(np.int64)
    stacked = np.stack([poses[view.frame_index] for view in views])
    found = triangulate_tracks(keypoints[order], camera_index[order], offsets, stacked, camera.K)
    worst = np.maximum.reduceat(np.nan_to_num(found.errors, nan=np.inf), first)
    return int((found.in_front & (worst <= tolerance)).sum())


def same_poses(former: Poses, anew: Poses, max_error: float) -> bool:
    """Whether two maps of the same frames have the same poses, but for their worlds and scales.

    Args:
        former: of the one map.
        anew: of the other.
        max_error: % of the path that a segment may be wrong by; half of it, and of what two turns may differ by, counts
            as the same.
    """
    frames = sorted(set(former) & set(anew))
    if len(frames) < _LEAST_VIEWS:
        return False
    a, b = (np.stack([poses[frame] for frame in frames]) for poses in (former, anew))
    turned = se3.rotation_angle_deg(_turns(a).transpose(0, 2, 1) @ _turns(b))
    if turned.max() > SAME_PATH * SAME_TURN_DEG:
        return False
    centers, centers_anew = (se3.inverse(each)[:, :3, 3] for each in (a, b))
    return error_percent(centers_anew, centers) <= SAME_PATH * max_error


def _turns(cam_from_world: Float64) -> Float64:
    """(N, 3, 3) rotation since the first."""
    turns: Float64 = cam_from_world[:, :3, :3] @ cam_from_world[0, :3, :3].T
    return turns
