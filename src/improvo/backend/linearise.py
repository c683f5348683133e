"""The derivatives of one observation at a time: point in the camera, residuals, gradient and Hessian.

With x = R X + t, an observation is, to second order, a gradient (3,) and a Hessian A (3, 3) in the camera's own frame;
everything else follows from how x moves:

    the pose is perturbed from the left, x' = exp(w) x + v:   dx = v - [x] w     so  dx = G^T (v, w), G = (I; [x])
    the point moves in the world:                             dx = R dX

    camera block  G A G^T,   point block  R^T A R,   coupling  G A R      (the Huber loss only re-weights A)
"""
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

import math

import numpy as np

from improvo.compiled import compiled, inlined
from improvo.geometry.projection_kernels import huber, inverse_depth, point_in_camera, residual


@inlined
def depth_excess(constants, z):
    """How far the depth is outside of its range: one of the two depth residuals, the other is zero."""
    if z > constants.depth_max:
        return z - constants.depth_max
    if z < constants.depth_min:
        return z - constants.depth_min
    return 0.0


@compiled
def evaluate(constants, observations, poses, points):
    """The objective Omega."""
    total = 0.0
    for j in range(len(points)):
        for o in range(observations.first[j], observations.first[j + 1]):
            x, y, z = point_in_camera(poses[observations.camera[o]], points[j])
            scale = inverse_depth(z)
            u, v = residual(
                observations.keypoints[o], x, y, scale, constants.fx, constants.fy, constants.cx, constants.cy
            )
            excess = depth_excess(constants, z)
            squared_norm = u * u + v * v + constants.depth_weight * (excess * excess)
            total += observations.weights[o] * huber(squared_norm, constants.huber_width)[0]
    return total


@compiled
def errors_and_depths(constants, observations, poses, points):
    """Reprojection errors in pixels and depths, in the caller's order of the observations."""
    errors = np.empty(len(observations.order))
    depths = np.empty(len(observations.order))
    for j in range(len(points)):
        for o in range(observations.first[j], observations.first[j + 1]):
            x, y, z = point_in_camera(poses[observations.camera[o]], points[j])
            scale = inverse_depth(z)
            u, v = residual(
                observations.keypoints[o], x, y, scale, constants.fx, constants.fy, constants.cx, constants.cy
            )
            errors[observations.order[o]] = math.hypot(u, v)
            depths[observations.order[o]] = z
    return errors, depths


@inlined
def in_camera_frame(constants, x, y, z, keypoint, weight):
    """Gradient (3,) and Hessian A (xx, xz, yy, yz, zz; it has no xy) of half the observation's cost by x, y, z."""
    scale = inverse_depth(z)
    u, v = residual(keypoint, x, y, scale, constants.fx, constants.fy, constants.cx, constants.cy)
    excess = depth_excess(constants, z)
    stiffness = constants.depth_weight if excess != 0.0 else 0.0
    # the residuals' derivatives are (du_x, 0, du_z), (0, dv_y, dv_z) and, for the excess, (0, 0, 1)
    du_x, du_z = constants.fx * scale, -constants.fx * (x * scale) * scale
    dv_y, dv_z = constants.fy * scale, -constants.fy * (y * scale) * scale
    squared_norm = u * u + v * v + stiffness * (excess * excess)
    weight = weight * huber(squared_norm, constants.huber_width)[1]
    gradient = weight * du_x * u, weight * dv_y * v, weight * (du_z * u + dv_z * v + stiffness * excess)
    azz = weight * (du_z * du_z + dv_z * dv_z + stiffness)
    return gradient, (weight * du_x * du_x, weight * du_x * du_z, weight * dv_y * dv_y, weight * dv_y * dv_z, azz)


@inlined
def add_to_camera(gradient, hessian, x, y, z, g, A):
    """Add G g and the upper triangle of G A G^T, which is A, A [x]^T, [x] A [x]^T; N is [x] A."""
    gx, gy, gz = g
    axx, axz, ayy, ayz, azz = A
    gradient[0] += gx
    gradient[1] += gy
    gradient[2] += gz
    gradient[3] += y * gz - z * gy
    gradient[4] += z * gx - x * gz
    gradient[5] += x * gy - y * gx
    n00, n01, n02 = y * axz, y * ayz - z * ayy, y * azz - z * ayz
    n10, n11, n12 = z * axx - x * axz, -x * ayz, z * axz - x * azz
    n20, n21, n22 = -y * axx, x * ayy, x * ayz - y * axz
    hessian[0, 0] += axx
    hessian[0, 2] += axz
    hessian[0, 3] += n00
    hessian[0, 4] += n10
    hessian[0, 5] += n20
    hessian[1, 1] += ayy
    hessian[1, 2] += ayz
    hessian[1, 3] += n01
    hessian[1, 4] += n11
    hessian[1, 5] += n21
    hessian[2, 2] += azz
    hessian[2, 3] += n02
    hessian[2, 4] += n12
    hessian[2, 5] += n22
    hessian[3, 3] += y * n02 - z * n01
    hessian[3, 4] += z * n00 - x * n02
    hessian[3, 5] += x * n01 - y * n00
    hessian[4, 4] += z * n10 - x * n12
    hessian[4, 5] += x * n11 - y * n10
    hessian[5, 5] += x * n21 - y * n20


@compiled
def linearise(constants, observations, system, poses, points):
    """Gradient and Gauss-Newton Hessian of half the objective, with the coupling blocks left factored as A R."""
    free = len(observations.camera_of_free)
    system.camera_hessian[:] = 0.0
    system.camera_gradient[:] = 0.0
    for j in range(len(points)):
        point_is_free = observations.point_is_free[j]
        h00 = h01 = h02 = h11 = h12 = h22 = 0.0
        g0 = g1 = g2 = 0.0
        for o in range(observations.first[j], observations.first[j + 1]):
            pose, camera = poses[observations.camera[o]], observations.free_camera[o]
            x, y, z = point_in_camera(pose, points[j])
            g, A = in_camera_frame(constants, x, y, z, observations.keypoints[o], observations.weights[o])
            if camera < free:
                add_to_camera(system.camera_gradient[camera], system.camera_hessian[camera], x, y, z, g, A)
            if not point_is_free:
                continue

            # the point: A R, R^T A R and R^T g
            axx, axz, ayy, ayz, azz = A
            r00, r01, r02 = pose[0, 0], pose[0, 1], pose[0, 2]
            r10, r11, r12 = pose[1, 0], pose[1, 1], pose[1, 2]
            r20, r21, r22 = pose[2, 0], pose[2, 1], pose[2, 2]
            b00, b01, b02 = axx * r00 + axz * r20, axx * r01 + axz * r21, axx * r02 + axz * r22
            b10, b11, b12 = ayy * r10 + ayz * r20, ayy * r11 + ayz * r21, ayy * r12 + ayz * r22
            b20 = axz * r00 + ayz * r10 + azz * r20
            b21 = axz * r01 + ayz * r11 + azz * r21
            b22 = axz * r02 + ayz * r12 + azz * r22
            h00 += r00 * b00 + r10 * b10 + r20 * b20
            h01 += r00 * b01 + r10 * b11 + r20 * b21
            h02 += r00 * b02 + r10 * b12 + r20 * b22
            h11 += r01 * b01 + r11 * b11 + r21 * b21
            h12 += r01 * b02 + r11 * b12 + r21 * b22
            h22 += r02 * b02 + r12 * b12 + r22 * b22
            g0 += r00 * g[0] + r10 * g[1] + r20 * g[2]
            g1 += r01 * g[0] + r11 * g[1] + r21 * g[2]
            g2 += r02 * g[0] + r12 * g[1] + r22 * g[2]
            if camera < free:
                in_camera, coupling = system.in_camera[o], system.coupling[o]
                in_camera[0], in_camera[1], in_camera[2] = x, y, z
                coupling[0, 0], coupling[0, 1], coupling[0, 2] = b00, b01, b02
                coupling[1, 0], coupling[1, 1], coupling[1, 2] = b10, b11, b12
                coupling[2, 0], coupling[2, 1], coupling[2, 2] = b20, b21, b22
        hessian, gradient = system.point_hessian[j], system.point_gradient[j]
        hessian[0], hessian[1], hessian[2], hessian[3], hessian[4], hessian[5] = h00, h01, h02, h11, h12, h22
        gradient[0], gradient[1], gradient[2] = g0, g1, g2
