"""The map around the camera: the pose of a new view, search by projection, and new points."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np

from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.geometry.ransac import Ransac, absolute_pose
from improvo.geometry.triangulation import triangulate_tracks
from improvo.odometry.gates import FEWEST, MEMORY_FRAMES, MIN_PARALLAX_DEG, gate
from improvo.odometry.mapping.projection_search import match_by_projection
from improvo.odometry.point_store import PointStore
from improvo.odometry.refinement.keypoint_refinement import KeypointRefiner
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.view import NO_POINT, View, inherit_points, ransac_rows
from improvo.tracking.matching import match_units
from improvo.types import Float32, Float64, Int64, Mask

_WRONG_SHARE = 0.1  # of wrong matches that agree with a wrong pose, where the scene repeats or is mirrored
_SEARCH = 8.0 / 640.0  # of the picture's width, between a map point's projection and its keypoint
_FASTER = 5.0  # times the fastest step before a loss: the camera cannot be farther off where it is found again,
_FAST = 0.1  # unless it is within this share of the distance to what it sees, for each frame
_SAME_SIDE = 0.5  # cosine of the angle between two rays to a point; features are not matched over 60 degrees


class LocalMap:
    """Points and the views that saw them last.

    Args:
        camera: pinhole camera of the frames.
        settings: of the odometry.
        descriptor_distance: the matching threshold on unit descriptors of this frontend.
    """

    def __init__(self, camera: Camera, settings: OdometrySettings, descriptor_distance: float) -> None:
        self.camera = camera
        self.store = PointStore()
        self.history: deque[View] = deque(maxlen=MEMORY_FRAMES)  # in order of processing, the newest last
        self.refused = 0  # points of the view localised last, found at a place where the camera can hardly be
        self._settings = settings
        self._descriptor_distance = descriptor_distance
        self.refiner = KeypointRefiner(camera, settings.tolerance)
        self._max_error = gate(settings.tolerance)  # pixels, of an observation
        self._search_radius = max(self._max_error, _SEARCH * camera.width)

    def remember(self, view: View) -> None:
        """The view is processed: its points were seen last in it."""
        self.store.last_seen[view.points[view.observed]] = view.frame_index
        self.history.append(view)

    def remember_in_order(self, views: Iterable[View]) -> None:
        """Views that were processed in any order count as seen one after the other, each once."""
        self.history.clear()
        for view in sorted(views, key=lambda view: view.frame_index):
            self.remember(view)

    def localise(self, view: View, neighbour: View) -> tuple[int, float]:
        """Pose of a view from the map points that its tracks share with a neighbour: PnP, then search by projection.

        If they are too few, the view is matched by descriptors with earlier views, the newest first.

        Args:
            view: gets a pose and points; neither if it shows too little of the map.
            neighbour: a view of the map, just before or after.

        Returns:
            Number of PnP inliers, and their share of the 3D-to-2D matches.
        """
        self.refused = 0
        inherit_points(view, neighbour)
        inliers, share = self._solve_pose(view)
        if self._is_lost(inliers, share) or not self._from_same_side(view, neighbour):
            for earlier in reversed(self.history):
                self._match_with(view, earlier)
                inliers, share = self._solve_pose(view)
                if self._is_lost(inliers, share):
                    continue
                if self._from_same_side(view, earlier) and self._can_be_reached(view, neighbour):
                    break
                self.refused = max(self.refused, inliers)
            else:
                view.cam_from_world = None
                view.points[:] = NO_POINT
                return inliers, share
        self._search_by_projection(view)
        self.refiner.update_poses(self.history)
        self.refiner.refine([(view, view.observed)], self.store)
        return inliers, share

    def _is_lost(self, inliers: int, share: float) -> bool:
        outliers = inliers / share - inliers if share > 0 else 0.0
        return inliers < FEWEST + _WRONG_SHARE * outliers

    def _from_same_side(self, view: View, other: View) -> bool:
        """Whether a view sees its points from where another one, with a pose, can have seen the same of them.

        A mirrored picture of a wall is the wall seen from behind: a good pose, and a wrong one.
        """
        assert view.cam_from_world is not None
        assert other.cam_from_world is not None
        xyz = self.store.xyz[view.points[view.observed]]
        if len(xyz) == 0:
            return False
        rays = [xyz - se3.inverse(pose)[:3, 3] for pose in (view.cam_from_world, other.cam_from_world)]
        cosine = (rays[0] * rays[1]).sum(axis=1) / np.maximum(np.prod(np.linalg.norm(rays, axis=2), axis=0), 1e-12)
        return bool(np.median(cosine) > _SAME_SIDE)

    def _can_be_reached(self, view: View, neighbour: View) -> bool:
        """Whether the camera can have come from a neighbour's place to a view's within the frames between.

        Things of which there are two look alike, and a place beside the one is found again beside the other.
        """
        assert view.cam_from_world is not None
        assert neighbour.cam_from_world is not None
        posed = [(each.frame_index, each.cam_from_world) for each in self.history if each.cam_from_world is not None]
        centers = np.array([se3.inverse(pose)[:3, 3] for _, pose in posed]).reshape(-1, 3)
        steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
        frames = np.maximum(np.abs(np.diff([index for index, _ in posed])), 1)
        fastest = float((steps / frames).max(initial=0.0))
        center = se3.inverse(view.cam_from_world)[:3, 3]
        seen = np.linalg.norm(self.store.xyz[view.points[view.observed]] - center, axis=1)
        far = np.linalg.norm(center - se3.inverse(neighbour.cam_from_world)[:3, 3])
        limit = max(_FASTER * fastest, _FAST * float(np.median(seen)))
        return bool(far <= limit * abs(view.frame_index - neighbour.frame_index))

    def _match_with(self, view: View, earlier: View) -> None:
        """3D-to-2D matches of a view by descriptors alone, against the map points of one earlier view."""
        view.points[:] = NO_POINT
        rows = earlier.observed
        matches = match_units(earlier.descriptors[rows], view.descriptors, self._descriptor_distance)
        matches = matches[~view.attached[matches[:, 1]]]
        view.points[matches[:, 1]] = earlier.points[rows[matches[:, 0]]]

    def _solve_pose(self, view: View) -> tuple[int, float]:
        """PnP on the points that pass the RANSAC gate; a keypoint that does not fit the pose loses its point."""
        rows = view.observed
        if len(rows) < 4:
            return 0, 0.0
        used = ransac_rows(view.weights[rows], self._settings)
        ransac = Ransac(self._max_error, self._settings.seed, min_iterations=100, max_iterations=2000)
        points = self.store.xyz[view.points[rows[used]]]
        found = absolute_pose(points, view.keypoints[rows[used]], self.camera, ransac)
        inliers = found.inliers
        view.cam_from_world = found.pose
        fits = np.zeros(len(rows), bool)
        fits[used] = inliers
        if not used.all():
            doubtful = rows[~used]
            pixels, visible = self.project(view.cam_from_world, self.store.xyz[view.points[doubtful]])
            fits[~used] = visible & (np.linalg.norm(pixels - view.keypoints[doubtful], axis=1) <= self._max_error)
        view.points[rows[~fits]] = NO_POINT
        return int(inliers.sum()), float(inliers.mean())

    def _search_by_projection(self, view: View) -> None:
        """Points of the last frames that the view should see take a free keypoint near their projection."""
        assert view.cam_from_world is not None
        ids, descriptors = self._points_to_search(view)
        projections, inside = self.project(view.cam_from_world, self.store.xyz[ids])
        free = np.flatnonzero((view.points < 0) & ~view.attached)
        pairs = match_by_projection(
            projections[inside],
            descriptors[inside],
            view.keypoints[free],
            view.descriptors[free],
            self._search_radius,
            self._descriptor_distance,
        )
        view.points[free[pairs[:, 1]]] = ids[inside][pairs[:, 0]]

    def _points_to_search(self, view: View) -> tuple[Int64, Float32]:
        """Ids (L,) of recently seen points that `view` does not observe, with their last descriptors (L, D)."""
        ids, descriptors = [np.zeros(0, np.int64)], [view.descriptors[:0]]
        last_seen = self.store.last_seen
        seen_now = np.zeros(self.store.count, bool)
        seen_now[view.points[view.observed]] = True
        for earlier in self.history:
            rows = earlier.observed
            points = earlier.points[rows]
            lost = (last_seen[points] == earlier.frame_index) & ~seen_now[points]
            ids.append(points[lost])
            descriptors.append(earlier.descriptors[rows[lost]])
        return np.concatenate(ids), np.concatenate(descriptors)

    def project(self, cam_from_world: Float64, xyz: Float64) -> tuple[Float64, Mask]:
        """Pixels (N, 2) of world points (N, 3), and whether they are in front of the camera and inside the image."""
        points_cam = se3.transform(cam_from_world, xyz)
        in_front = points_cam[:, 2] > 1e-6
        points_cam[~in_front, 2] = 1.0
        pixels = self.camera.project(points_cam)
        inside = (pixels >= -0.5).all(axis=1) & (pixels <= (self.camera.width - 0.5, self.camera.height - 0.5)).all(1)
        return pixels, in_front & inside

    def triangulate(self, view: View, others: Iterable[View]) -> int:
        """New map points from tracks of the view that have none yet.

        Args:
            view: the newest view, with a pose.
            others: views with poses in which the tracks may have been seen.

        Returns:
            How many points were made.
        """
        tracks = view.tracks[(view.points < 0) & ~view.attached]
        views = [view, *others]
        seen = [(v, np.flatnonzero(_among(v.tracks, tracks) & (v.points < 0) & ~v.attached)) for v in views]
        track = np.concatenate([v.tracks[rows] for v, rows in seen])
        camera = np.concatenate([np.full(len(rows), i) for i, (_, rows) in enumerate(seen)])
        row = np.concatenate([rows for _, rows in seen])
        order = np.lexsort((camera, track))
        track, camera, row = track[order], camera[order], row[order]
        keypoints = np.concatenate([v.keypoints[rows] for v, rows in seen])[order]
        _, offsets = np.unique(track, return_index=True)
        offsets = np.append(offsets, len(track)).astype(np.int64)
        poses = np.stack([v.cam_from_world for v in views if v.cam_from_world is not None])
        result = triangulate_tracks(keypoints, camera.astype(np.int64), offsets, poses, self.camera.K)
        counts = np.diff(offsets)
        worst = np.maximum.reduceat(result.errors, offsets[:-1]) if len(track) else np.zeros(0)
        good = result.in_front & (counts >= 2) & (result.parallax_deg >= MIN_PARALLAX_DEG) & (worst <= self._max_error)
        ids = np.full(len(counts), NO_POINT)
        ids[good] = self.store.add(result.points[good], view.frame_index)
        point = np.repeat(ids, counts)
        observations: list[tuple[View, Int64]] = []
        for i, v in enumerate(views):
            of_view = (camera == i) & (point >= 0)
            v.points[row[of_view]] = point[of_view]
            if of_view.any():
                observations.append((v, row[of_view]))
        self.refiner.refine(sorted(observations, key=lambda each: each[0].frame_index), self.store)
        return int(good.sum())


def _among(tracks: Int64, wanted: Int64) -> Mask:
    """(N,) which of the tracks (N,) are wanted (K,); by a table, since `numpy.isin` sorts both each time."""
    if len(wanted) == 0:
        return np.zeros(len(tracks), bool)
    first = int(wanted.min())
    table = np.zeros(int(wanted.max()) - first + 2, bool)  # the last entry stands for all that lie outside
    table[wanted - first] = True
    place = tracks - first
    outside = (place < 0) | (place >= len(table))
    return table[np.where(outside, len(table) - 1, place)]
