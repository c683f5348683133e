"""Starting a map from two views, then the views between and before them backwards (mode `robust`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import poselib

from improvo.backend.settings import SolverSettings
from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.geometry.triangulation import triangulate_tracks
from improvo.odometry.local_map import LocalMap, poselib_camera
from improvo.odometry.settings import OdometrySettings, StartSettings
from improvo.odometry.view import NO_POINT, View, common_tracks, ransac_pairs
from improvo.odometry.window import adjust
from improvo.tracking.matching import match_units
from improvo.types import Float64, Int64


@dataclass(frozen=True)
class TwoView:
    """Relative pose of two views and the points that support it."""

    b_from_a: Float64  # (4, 4), unit baseline
    rows_a: Int64  # (N,) keypoints of a
    rows_b: Int64  # (N,) keypoints of b
    xyz: Float64  # (N, 3) in camera a
    parallax_deg: Float64  # (N,)


@dataclass(frozen=True)
class InitFailure:
    """Why two views cannot start a map, in plain words."""

    reason: str
    costly: bool = False  # found only after much work: better not tried again with the very next frame


def two_view_geometry(
    a: View, b: View, camera: Camera, odometry: OdometrySettings, descriptor_distance: float
) -> TwoView | InitFailure:
    """Relative pose of two views by the five-point algorithm, gated by a rotation and by a homography.

    Where a pure rotation explains the matches, or a homography does about as well as an essential matrix, the
    translation and with it all depths would be noise; unless enough points contradict the homography, as before a wall.
    """
    settings = odometry.start
    matches = match_units(a.descriptors, b.descriptors, descriptor_distance)
    rows_a, rows_b = matches[ransac_pairs(a, b, matches, odometry.ransac_gate)].T
    if len(rows_a) < settings.min_matches:
        return InitFailure("too few matches")
    pixels_a, pixels_b = a.keypoints[rows_a], b.keypoints[rows_b]
    options = {
        "max_epipolar_error": settings.epipolar_error,
        "max_reproj_error": settings.epipolar_error,
        "min_iterations": 200,
        "max_iterations": 5000,
        "seed": odometry.seed,
    }
    shape = poselib_camera(camera)
    pose, essential = poselib.estimate_relative_pose(pixels_a, pixels_b, shape, shape, options)
    homography, planar = poselib.estimate_homography(pixels_a, pixels_b, options)
    inliers = np.asarray(essential["inliers"], bool)
    if inliers.sum() < max(settings.min_inlier_share * len(rows_a), settings.min_points):
        return InitFailure("too few matches agree on a motion")
    if np.median(rotation_residuals(camera, pixels_a[inliers], pixels_b[inliers])) < settings.min_rotation_residual:
        return InitFailure("too little parallax: a rotation explains the motion")
    ratio = np.sum(planar["inliers"]) / max(inliers.sum(), 1)
    on_plane = np.asarray(planar["inliers"], bool)
    if ratio > settings.max_homography_ratio and (inliers & ~on_plane).sum() < settings.min_off_plane_points:
        if ratio < settings.plane_ratio:
            return InitFailure("too little parallax")
        return _from_plane(a, b, rows_a, rows_b, homography, on_plane, camera, settings)
    return _points_of(a, b, rows_a[inliers], rows_b[inliers], se3.rigid(pose.R, pose.t), camera, settings)


def rotation_residuals(camera: Camera, pixels_a: Float64, pixels_b: Float64) -> Float64:
    """Pixels (N,) that the best pure rotation of the camera leaves unexplained; robust to moderate outliers."""
    rays_a, rays_b = camera.unproject(pixels_a), camera.unproject(pixels_b)
    rays_a /= np.linalg.norm(rays_a, axis=1, keepdims=True)
    rays_b /= np.linalg.norm(rays_b, axis=1, keepdims=True)
    weights = np.ones(len(rays_a))
    residuals = weights
    for _ in range(8):
        b_from_a = se3.nearest_rotation((rays_b * weights[:, None]).T @ rays_a)
        turned = rays_a @ b_from_a.T
        turned[:, 2] = np.maximum(turned[:, 2], 1e-3)
        residuals = np.linalg.norm(camera.project(turned) - pixels_b, axis=1)
        weights = 1.0 / np.maximum(residuals, 1.0)
    return residuals


def _points_of(
    a: View, b: View, rows_a: Int64, rows_b: Int64, b_from_a: Float64, camera: Camera, settings: StartSettings
) -> TwoView | InitFailure:
    """Triangulate the matches; refuse if too few have parallax."""
    count = len(rows_a)
    keypoints = np.stack([a.keypoints[rows_a], b.keypoints[rows_b]], axis=1).reshape(-1, 2)
    poses = np.stack([np.eye(4), b_from_a])
    offsets = np.arange(0, 2 * count + 1, 2)
    result = triangulate_tracks(keypoints, np.tile([0, 1], count), offsets, poses, camera.K)
    worst = result.errors.reshape(-1, 2).max(axis=1)
    parallax_deg = result.parallax_deg
    good = (
        result.in_front & (worst <= 2.0 * settings.epipolar_error) & (parallax_deg > 0.25 * settings.min_parallax_deg)
    )
    if (parallax_deg[good] >= settings.min_parallax_deg).sum() < settings.min_points:
        return InitFailure("too little parallax")
    return TwoView(b_from_a, rows_a[good], rows_b[good], result.points[good], parallax_deg[good])


def _from_plane(
    a: View,
    b: View,
    rows_a: Int64,
    rows_b: Int64,
    homography: Float64,
    inliers: np.ndarray,
    camera: Camera,
    settings: StartSettings,
) -> TwoView | InitFailure:
    """The motion over a plane whose decomposition puts most points in front of both cameras, if it is unique."""
    normalised = np.linalg.inv(camera.K) @ homography @ camera.K
    solutions = []
    for pose in poselib.motion_from_homography(normalised)[0]:
        length = float(np.linalg.norm(pose.t))
        if length < 1e-6:
            continue
        b_from_a = se3.rigid(pose.R, pose.t / length)
        points = _points_of(a, b, rows_a[inliers], rows_b[inliers], b_from_a, camera, settings)
        if isinstance(points, TwoView):
            solutions.append(points)
    solutions.sort(key=lambda solution: -len(solution.rows_a))
    if not solutions:
        return InitFailure("too little parallax")
    if len(solutions) > 1 and len(solutions[1].rows_a) > 0.75 * len(solutions[0].rows_a):
        return InitFailure("a plane with two possible motions")
    return solutions[0]


def start_map(
    waiting: Sequence[View], camera: Camera, settings: OdometrySettings, descriptor_distance: float
) -> LocalMap | InitFailure:
    """Poses for all waiting views from the first good pair (earliest view with enough common tracks, last view).

    Every other view gets the full step, PnP, triangulation and adjustment, going backwards from the last.

    Returns:
        The map, world = camera of the first view that got a pose, median depth 1; or why it is too early. After a
        failure the views have neither poses nor points.
    """
    start = settings.start
    b = waiting[-1]
    a = next((v for v in waiting[:-1] if len(common_tracks(v, b)[0]) >= start.min_common_tracks), None)
    if a is None:
        return InitFailure("too few tracks")
    pair = two_view_geometry(a, b, camera, settings, descriptor_distance)
    if isinstance(pair, InitFailure):
        return pair
    local_map = LocalMap(camera, settings, descriptor_distance)
    failure = _grow(waiting, a, b, pair, local_map, settings)
    if failure is not None:
        for view in waiting:
            view.cam_from_world = None
            view.points[:] = NO_POINT
        return failure
    _normalise([view for view in waiting if view.cam_from_world is not None], local_map)
    return local_map


def _grow(
    waiting: Sequence[View], a: View, b: View, pair: TwoView, local_map: LocalMap, settings: OdometrySettings
) -> InitFailure | None:
    """Two views, then all others backwards, then all together."""
    K, store, start = local_map.camera.K, local_map.store, settings.start
    ids = store.add(pair.xyz, b.frame_index)
    a.cam_from_world, b.cam_from_world = np.eye(4), pair.b_from_a
    a.points[pair.rows_a], b.points[pair.rows_b] = ids, ids
    solver = SolverSettings(max_iterations=30, relative_decrease=1e-4)
    max_error = settings.window.max_error
    report = adjust([b], [a], store, K, settings.objective, solver, max_error)
    if report.mean_error > start.max_mean_error or report.kept < 2 * start.min_points:
        return InitFailure("the first two views do not fit")
    local_map.remember(a)
    local_map.remember(b)
    done = [b]
    neighbour, missed = b, 0
    for view in reversed(waiting[:-1]):
        if view is not a:
            local_map.localise(view, neighbour)
            if view.cam_from_world is None:
                missed += 1
                if missed <= start.max_lost:
                    continue
                if view.frame_index > a.frame_index:
                    return InitFailure("the first views do not fit together", costly=True)
                break  # what lies before is another place, or too blurred
            missed = 0
        done.append(view)
        others = done[-16:-1]
        local_map.triangulate(view, others if view is a or a in others else [*others, a])
        free, fixed = _start_window(done, a)
        adjust(free, fixed, store, K, settings.objective, settings.solver, max_error)
        local_map.remember(view)
        neighbour = view
    first, *rest = sorted(done, key=lambda view: view.frame_index)
    report = adjust(rest, [first], store, K, settings.objective, solver, max_error)
    if not report.mean_error <= start.max_mean_error:
        return InitFailure("the first views do not fit together", costly=True)
    return None


def _start_window(done: list[View], a: View) -> tuple[list[View], list[View]]:
    """The last views free, the earlier ones and the first pair's `a` fixed."""
    free = [view for view in done[-15:] if view is not a]
    fixed = [a, *(view for view in done[:-15] if view is not a)][:31]
    return free, fixed


def _normalise(views: Sequence[View], local_map: LocalMap) -> None:
    """World = camera of the first view, and its median depth = 1 (DESIGN: conventions)."""
    first = views[0]
    assert first.cam_from_world is not None
    first_from_world = first.cam_from_world
    xyz = se3.transform(first_from_world, local_map.store.xyz)
    depths = xyz[first.points[first.observed], 2]
    scale = 1.0 / float(np.median(depths)) if len(depths) else 1.0
    local_map.store.xyz[:] = scale * xyz
    world_from_old = se3.inverse(first_from_world)
    for view in views:
        assert view.cam_from_world is not None
        view.cam_from_world = view.cam_from_world @ world_from_old
        view.cam_from_world[:3, 3] *= scale
