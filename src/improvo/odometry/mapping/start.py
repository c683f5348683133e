"""Starting a map (mode `robust`): a good pair of views, then all other buffered views backwards from the last."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from improvo.backend.settings import SolverSettings
from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.odometry.gates import gate
from improvo.odometry.mapping.bundle_adjustment import OBJECTIVE, SOLVER, adjust
from improvo.odometry.mapping.initial_pair import InitFailure, InitialPair, initial_pair
from improvo.odometry.mapping.local_map import LocalMap
from improvo.odometry.settings import OdometrySettings, WindowSettings
from improvo.odometry.view import View, common_tracks

_PATIENT = SolverSettings(max_iterations=30, relative_decrease=1e-4)  # of the first pair, and of all views at the end


def start_map(
    buffer: Sequence[View], camera: Camera, settings: OdometrySettings, descriptor_distance: float
) -> LocalMap | InitFailure:
    """Poses for all buffered views, from the first good pair.

    The pair is the last view and the earliest one that shares enough tracks with it. Every other view gets the full
    step, PnP, triangulation and adjustment, going backwards from the last.

    Args:
        buffer: consecutive views without poses, at least two.
        camera: pinhole camera of the views.
        settings: of the odometry.
        descriptor_distance: the matching threshold on unit descriptors.

    Returns:
        The map, or why it is too early for one. The world is the camera of the first view that got a pose, and the
        median depth in it is 1. After a failure the views have neither poses nor points.
    """
    b = buffer[-1]
    least = settings.start.min_points
    a = next((view for view in buffer[:-1] if _shared(view, b) >= least), None)
    if a is None:
        return InitFailure("too few tracks")
    pair = initial_pair(a, b, camera, settings, descriptor_distance)
    if isinstance(pair, InitFailure):
        return pair
    local_map = LocalMap(camera, settings, descriptor_distance)
    failure = _grow(buffer, a, b, pair, local_map, settings)
    if failure is not None:
        for view in buffer:
            view.forget_pose()
        return failure
    _normalise([view for view in buffer if view.cam_from_world is not None], local_map)
    return local_map


def _shared(a: View, b: View) -> int:
    """Tracks that two views share; what moves with the camera is no reason to think that they see the same place."""
    rows_a, rows_b = common_tracks(a, b)
    return int((~(a.attached[rows_a] | b.attached[rows_b])).sum())


def _grow(
    buffer: Sequence[View], a: View, b: View, pair: InitialPair, local_map: LocalMap, settings: OdometrySettings
) -> InitFailure | None:
    """Two views, then all others backwards, then all together."""
    K, store, window = local_map.camera.K, local_map.store, settings.window
    max_error = gate(settings.tolerance)
    ids = store.add(pair.xyz, b.frame_index)
    a.cam_from_world, b.cam_from_world = np.eye(4), pair.b_from_a
    a.points[pair.rows_a], b.points[pair.rows_b] = ids, ids
    report = adjust([b], [a], store, K, OBJECTIVE, _PATIENT, max_error)
    if report.mean_error > settings.tolerance or report.kept < 2 * settings.start.min_points:
        return InitFailure("the first two views do not fit")
    local_map.refiner.refine([(a, a.observed), (b, b.observed)], store)
    local_map.remember(a)
    local_map.remember(b)
    done = [b]
    neighbour, missed = b, 0
    for view in reversed(buffer[:-1]):
        if view is not a:
            local_map.localise(view, neighbour)
            if view.cam_from_world is None:
                missed += 1
                if missed <= settings.loss.max_lost_frames:
                    continue
                if view.frame_index > a.frame_index:
                    return InitFailure("the first views do not fit together", costly=True)
                break  # what lies before is another place, or too blurred
            missed = 0
        done.append(view)
        others = done[-(window.recent + 1) : -1]
        local_map.triangulate(view, others if view is a or a in others else [*others, a])
        free, fixed = _free_and_fixed(done, a, window)
        adjust(free, fixed, store, K, OBJECTIVE, SOLVER, max_error)
        local_map.remember(view)
        neighbour = view
    first, *rest = sorted(done, key=lambda view: view.frame_index)
    report = adjust(rest, [first], store, K, OBJECTIVE, _PATIENT, max_error)
    if not report.mean_error <= settings.tolerance:
        return InitFailure("the first views do not fit together", costly=True)
    local_map.remember_in_order(done)
    return None


def _free_and_fixed(done: list[View], a: View, window: WindowSettings) -> tuple[list[View], list[View]]:
    """The last views are free; the pair's `a`, which holds the gauge, and earlier ones are fixed."""
    free = [view for view in done[-window.recent :] if view is not a]
    fixed = [a, *(view for view in done[: -window.recent] if view is not a)][: 1 + window.fixed]
    return free, fixed


def _normalise(views: Sequence[View], local_map: LocalMap) -> None:
    """World = camera of the first view, and its median depth = 1 (docs/conventions.md)."""
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
    local_map.refiner.update_poses(views)
