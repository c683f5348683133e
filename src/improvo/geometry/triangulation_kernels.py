"""The compiled parts of `improvo.geometry.triangulation`: rays, starting points, robust refinement, parallax."""
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

import math

import numpy as np

from improvo.compiled import compiled
from improvo.geometry.projection_kernels import huber, inverse_depth, point_in_camera, residual

_SPREAD = 5  # views, evenly spaced over the track, whose pairs are two-view starts
_PARALLAX_VIEWS = 48  # of a longer track, this many evenly spaced views decide its parallax
_FAR = 50.0  # baselines: depth of the start for a point that no ray pair sees in front


@compiled
def triangulate_all(keypoints, camera_index, offsets, cam_from_world, intrinsics, redescending, width, max_iterations):
    """Points (T, 3), errors (O,), parallax in degrees (T,), in front of all cameras (T,)."""
    tracks = len(offsets) - 1
    points = np.full((tracks, 3), np.nan)
    errors = np.full(len(keypoints), np.nan)
    parallax_deg = np.zeros(tracks)
    in_front = np.zeros(tracks, np.bool_)
    has_pose = np.empty(len(cam_from_world), np.bool_)
    for i in range(len(cam_from_world)):
        has_pose[i] = np.isfinite(cam_from_world[i].sum())
    centres = _camera_centres(cam_from_world)

    longest = 0
    for t in range(tracks):
        longest = max(longest, offsets[t + 1] - offsets[t])
    rows = np.empty(longest, np.int64)
    rays = np.empty((longest, 3))
    point, candidate = np.empty(3), np.empty(3)
    for t in range(tracks):
        count = 0
        for row in range(offsets[t], offsets[t + 1]):
            if has_pose[camera_index[row]]:
                rows[count] = row
                count += 1
        if count < 2:
            continue
        point[:] = np.nan
        views = rows[:count]
        _world_rays(keypoints, camera_index, views, cam_from_world, intrinsics, rays)
        _start(keypoints, camera_index, views, rays, centres, cam_from_world, intrinsics, redescending, width,
               point, candidate)  # fmt: skip
        _refine(keypoints, camera_index, views, cam_from_world, intrinsics, redescending, width, max_iterations,
                point, candidate)  # fmt: skip
        points[t] = point
        front = True
        for row in views:
            x, y, z = point_in_camera(cam_from_world[camera_index[row]], point)
            u, v = _residual(keypoints[row], x, y, z, intrinsics)
            errors[row] = math.hypot(u, v)
            front = front and z > 0.0
        in_front[t] = front
        parallax_deg[t] = _parallax_deg(camera_index, views, centres, point)
    return points, errors, parallax_deg, in_front


@compiled
def _camera_centres(cam_from_world):
    centres = np.empty((len(cam_from_world), 3))
    for i in range(len(cam_from_world)):
        pose = cam_from_world[i]
        for k in range(3):
            centres[i, k] = -(pose[0, k] * pose[0, 3] + pose[1, k] * pose[1, 3] + pose[2, k] * pose[2, 3])
    return centres


@compiled
def _world_rays(keypoints, camera_index, views, cam_from_world, intrinsics, rays):
    """Unit directions, in the world, in which the cameras saw the track."""
    fx, fy, cx, cy = intrinsics
    for n in range(len(views)):
        pose, keypoint = cam_from_world[camera_index[views[n]]], keypoints[views[n]]
        x, y = (keypoint[0] - cx) / fx, (keypoint[1] - cy) / fy
        scale = 1.0 / math.sqrt(x * x + y * y + 1.0)
        for k in range(3):
            rays[n, k] = (pose[0, k] * x + pose[1, k] * y + pose[2, k]) * scale


@compiled
def _residual(keypoint, x, y, z, intrinsics):
    fx, fy, cx, cy = intrinsics
    return residual(keypoint, x, y, inverse_depth(z), fx, fy, cx, cy)


@compiled
def _loss(squared_error, redescending, width):
    """The robust loss and its slope: Geman-McClure s / (1 + s / width^2), or Huber."""
    if redescending:
        shrink = 1.0 / (1.0 + squared_error / (width * width))
        return squared_error * shrink, shrink * shrink
    return huber(squared_error, width)


@compiled
def _cost(keypoints, camera_index, views, cam_from_world, intrinsics, redescending, width, point):
    """The robust cost of a point; infinite where most views have it behind them."""
    total = 0.0
    behind = 0
    for row in views:
        x, y, z = point_in_camera(cam_from_world[camera_index[row]], point)
        u, v = _residual(keypoints[row], x, y, z, intrinsics)
        total += _loss(u * u + v * v, redescending, width)[0]
        behind += z <= 0.0
    return math.inf if 2 * behind >= len(views) or not total < math.inf else total


@compiled
def _start(keypoints, camera_index, views, rays, centres, cam_from_world, intrinsics, redescending, width,
           point, candidate):  # fmt: skip
    """The best of: nearest to all rays, nearest to two of them, far along the middle ray."""
    count = len(views)
    first, middle, last = centres[camera_index[views[0]]], count // 2, centres[camera_index[views[count - 1]]]
    baseline = math.sqrt((first[0] - last[0]) ** 2 + (first[1] - last[1]) ** 2 + (first[2] - last[2]) ** 2)
    far = _FAR * baseline if baseline > 0.0 else 1.0
    for k in range(3):
        point[k] = centres[camera_index[views[middle]], k] + far * rays[middle, k]
    best = _cost(keypoints, camera_index, views, cam_from_world, intrinsics, redescending, width, point)

    spread = min(_SPREAD, count)
    for pair in range(spread * spread):
        a, b = pair // spread, pair % spread
        if a > b or (a == b and a > 0):
            continue
        if a == b:  # once, in place of a pair: all rays
            found = _nearest_to_rays(camera_index, views, rays, centres, 0, count - 1, 1, candidate)
        else:
            one, other = a * (count - 1) // (spread - 1), b * (count - 1) // (spread - 1)
            found = _nearest_to_rays(camera_index, views, rays, centres, one, other, other - one, candidate)
        if not found:
            continue
        cost = _cost(keypoints, camera_index, views, cam_from_world, intrinsics, redescending, width, candidate)
        if cost < best:
            best = cost
            point[:] = candidate


@compiled
def _nearest_to_rays(camera_index, views, rays, centres, start, stop, step, point):
    """Least squares of the distances to the rays start, start + step, ..., stop; False for parallel rays."""
    a00 = a01 = a02 = a11 = a12 = a22 = 0.0
    b0 = b1 = b2 = 0.0
    for n in range(start, stop + 1, step):
        d0, d1, d2 = rays[n, 0], rays[n, 1], rays[n, 2]
        centre = centres[camera_index[views[n]]]
        along = d0 * centre[0] + d1 * centre[1] + d2 * centre[2]
        a00 += 1.0 - d0 * d0
        a01 -= d0 * d1
        a02 -= d0 * d2
        a11 += 1.0 - d1 * d1
        a12 -= d1 * d2
        a22 += 1.0 - d2 * d2
        b0 += centre[0] - d0 * along
        b1 += centre[1] - d1 * along
        b2 += centre[2] - d2 * along
    return _solve_symmetric(a00, a01, a02, a11, a12, a22, b0, b1, b2, point)


@compiled
def _solve_symmetric(a00, a01, a02, a11, a12, a22, b0, b1, b2, solution):
    """Solve a 3x3 symmetric positive definite system by cofactors; False where it is singular."""
    c00, c01, c02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
    determinant = a00 * c00 + a01 * c01 + a02 * c02
    trace = a00 + a11 + a22
    if not determinant > 1e-14 * trace * trace * trace:
        return False
    c11, c12, c22 = a00 * a22 - a02 * a02, a01 * a02 - a00 * a12, a00 * a11 - a01 * a01
    solution[0] = (c00 * b0 + c01 * b1 + c02 * b2) / determinant
    solution[1] = (c01 * b0 + c11 * b1 + c12 * b2) / determinant
    solution[2] = (c02 * b0 + c12 * b1 + c22 * b2) / determinant
    return True


@compiled
def _refine(keypoints, camera_index, views, cam_from_world, intrinsics, redescending, width, max_iterations,
            point, candidate):  # fmt: skip
    """Damped, re-weighted Gauss-Newton on the reprojection errors; never leaves a worse point."""
    fx, fy = intrinsics[0], intrinsics[1]
    cost = _cost(keypoints, camera_index, views, cam_from_world, intrinsics, redescending, width, point)
    step = np.empty(3)
    damping = 1e-4
    for _ in range(max_iterations):
        a00 = a01 = a02 = a11 = a12 = a22 = 0.0
        b0 = b1 = b2 = 0.0
        for row in views:
            pose = cam_from_world[camera_index[row]]
            x, y, z = point_in_camera(pose, point)
            u, v = _residual(keypoints[row], x, y, z, intrinsics)
            weight = _loss(u * u + v * v, redescending, width)[1]
            scale = inverse_depth(z)
            du_z, dv_z = -x * scale, -y * scale
            for axis in range(2):
                residual, row_of_pose, by_depth = (u, pose[0], du_z) if axis == 0 else (v, pose[1], dv_z)
                focal = (fx if axis == 0 else fy) * scale
                j0 = focal * (row_of_pose[0] + by_depth * pose[2, 0])
                j1 = focal * (row_of_pose[1] + by_depth * pose[2, 1])
                j2 = focal * (row_of_pose[2] + by_depth * pose[2, 2])
                a00 += weight * j0 * j0
                a01 += weight * j0 * j1
                a02 += weight * j0 * j2
                a11 += weight * j1 * j1
                a12 += weight * j1 * j2
                a22 += weight * j2 * j2
                b0 -= weight * j0 * residual
                b1 -= weight * j1 * residual
                b2 -= weight * j2 * residual
        grow = 1.0 + damping
        if not _solve_symmetric(a00 * grow, a01, a02, a11 * grow, a12, a22 * grow, b0, b1, b2, step):
            damping = max(damping * 100.0, 1e-2)
            continue
        for k in range(3):
            candidate[k] = point[k] + step[k]
        new_cost = _cost(keypoints, camera_index, views, cam_from_world, intrinsics, redescending, width, candidate)
        if not new_cost < cost:
            if not new_cost > cost * (1.0 + 1e-12):
                break
            damping = max(damping * 100.0, 1e-2)
            continue
        decrease = cost - new_cost
        cost = new_cost
        point[:] = candidate
        damping *= 0.1
        if decrease <= 1e-8 * cost:
            break


@compiled
def _parallax_deg(camera_index, views, centres, point):
    """The largest angle under which the point sees two of its cameras."""
    count = min(len(views), _PARALLAX_VIEWS)
    directions = np.empty((count, 3))
    for n in range(count):
        view = n if count == len(views) else n * (len(views) - 1) // (count - 1)
        centre = centres[camera_index[views[view]]]
        d0, d1, d2 = centre[0] - point[0], centre[1] - point[1], centre[2] - point[2]
        norm = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        scale = 1.0 / norm if norm > 0.0 else 0.0
        directions[n, 0], directions[n, 1], directions[n, 2] = d0 * scale, d1 * scale, d2 * scale
    widest = 0.0
    for a in range(count):
        for b in range(a + 1, count):
            d0, d1 = directions[a, 0] - directions[b, 0], directions[a, 1] - directions[b, 1]
            d2 = directions[a, 2] - directions[b, 2]
            widest = max(widest, d0 * d0 + d1 * d1 + d2 * d2)
    return math.degrees(2.0 * math.asin(min(1.0, 0.5 * math.sqrt(widest))))
