"""The Schur complement over the points: each free point is a 3x3 block that is eliminated in closed form.

With V = L L^T the damped block of a point and W its coupling with a camera, Y = W L^-T gives all that is needed:

    reduced system    S = U - sum Y Y^T,     right side  -(g_c - sum Y L^-1 g_p)
    back-substitution dX = -V^-1 (g_p + sum W^T dc)
"""
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

import math

from improvo.backend.arrange import CHUNK, COLUMN, POSE, STRIDE
from improvo.compiled import compiled


@compiled
def eliminate(observations, system, damping, min_diagonal):
    """Fill the reduced system and its right side (in `camera_step`); False where a block is not positive definite."""
    cameras = len(observations.camera_of_free)
    for camera in range(cameras):
        _start_block(system, camera, damping, min_diagonal)
    for j in observations.point_order:
        if not observations.point_is_free[j]:
            continue
        if not _invert_root(system, j, damping, min_diagonal):
            return False
        first, last = observations.first[j], observations.first_fixed[j]
        for a in range(first, last):
            _couple(observations, system, j, a, a - first)
        for a in range(first, last):
            start = observations.first_of_camera[a]
            while start < last:
                end = observations.run_end[start]
                row = block_start(cameras, observations.free_camera[a], observations.free_camera[start])
                columns, left = slice(COLUMN * (start - first), COLUMN * (end - first)), COLUMN * (a - first)
                subtract_rank_3(
                    system.reduced[row:],
                    system.elimination[:, left : left + POSE],
                    system.elimination[0, columns],
                    system.elimination[1, columns],
                    system.elimination[2, columns],
                )
                start = end
    return True


@compiled
def block_start(cameras, camera_a, camera_b):
    """Where the first row of the block of two cameras starts in the flat reduced system."""
    chunks = (cameras + CHUNK - 1) // CHUNK
    return (camera_a * chunks + camera_b // CHUNK) * (POSE * STRIDE) + camera_b % CHUNK * COLUMN


@compiled
def chunk_end(start, cameras):
    """The first camera after `start` whose columns lie in another piece of the rows."""
    return min((start // CHUNK + 1) * CHUNK, cameras)


@compiled
def subtract_rank_3(rows, left, right0, right1, right2):
    """Take left^T right from six rows at once: the innermost loop, where half of the solver's time goes."""
    a0, a1, a2, a3, a4, a5 = left[0, 0], left[0, 1], left[0, 2], left[0, 3], left[0, 4], left[0, 5]
    b0, b1, b2, b3, b4, b5 = left[1, 0], left[1, 1], left[1, 2], left[1, 3], left[1, 4], left[1, 5]
    c0, c1, c2, c3, c4, c5 = left[2, 0], left[2, 1], left[2, 2], left[2, 3], left[2, 4], left[2, 5]
    # the width is whole columns; said so that the compiler sees it, it needs no loop for a remainder, and keeps in
    # registers what that loop would hold (a fifth of the time)
    for k in range(len(right0) >> 3 << 3):
        p, q, r = right0[k], right1[k], right2[k]
        rows[k] -= a0 * p + b0 * q + c0 * r
        rows[k + STRIDE] -= a1 * p + b1 * q + c1 * r
        rows[k + 2 * STRIDE] -= a2 * p + b2 * q + c2 * r
        rows[k + 3 * STRIDE] -= a3 * p + b3 * q + c3 * r
        rows[k + 4 * STRIDE] -= a4 * p + b4 * q + c4 * r
        rows[k + 5 * STRIDE] -= a5 * p + b5 * q + c5 * r


@compiled
def _start_block(system, camera, damping, min_diagonal):
    """The rows of a camera before any point is taken from them: its own block, damped; and minus its gradient."""
    hessian = system.camera_hessian[camera]
    cameras = len(system.camera_hessian)
    start = camera
    while start < cameras:
        end = chunk_end(start, cameras)
        row = block_start(cameras, camera, start)
        for i in range(6):
            system.reduced[row + i * STRIDE : row + i * STRIDE + COLUMN * (end - start)] = 0.0
        start = end
    block = system.reduced[block_start(cameras, camera, camera) :]
    for i in range(6):
        for k in range(i, 6):
            block[i * STRIDE + k] = hessian[i, k]
        block[i * STRIDE + i] += damping * max(hessian[i, i], min_diagonal)
        system.camera_step[camera, i] = -system.camera_gradient[camera, i]


@compiled
def _invert_root(system, j, damping, min_diagonal):
    """L^-1 of the damped 3x3 block of point j, and L^-1 g."""
    hessian, root = system.point_hessian[j], system.point_root[j]
    pivot = hessian[0] + damping * max(hessian[0], min_diagonal)
    if not pivot > 0.0:
        return False
    l00 = 1.0 / math.sqrt(pivot)
    l10, l20 = hessian[1] * l00, hessian[2] * l00
    pivot = hessian[3] + damping * max(hessian[3], min_diagonal) - l10 * l10
    if not pivot > 0.0:
        return False
    l11 = 1.0 / math.sqrt(pivot)
    l21 = (hessian[4] - l20 * l10) * l11
    pivot = hessian[5] + damping * max(hessian[5], min_diagonal) - l20 * l20 - l21 * l21
    if not pivot > 0.0:
        return False
    l22 = 1.0 / math.sqrt(pivot)
    i10 = -l10 * l00 * l11
    i21 = -l21 * l11 * l22
    i20 = -(l20 * l00 + l21 * i10) * l22
    root[0], root[1], root[2], root[3], root[4], root[5] = l00, i10, l11, i20, i21, l22
    g0, g1, g2 = system.point_gradient[j, 0], system.point_gradient[j, 1], system.point_gradient[j, 2]
    system.point_rhs[j, 0] = l00 * g0
    system.point_rhs[j, 1] = i10 * g0 + l11 * g1
    system.point_rhs[j, 2] = i20 * g0 + i21 * g1 + l22 * g2
    return True


@compiled
def _couple(observations, system, j, o, slot):
    """Y = (I; [x]) A R L^-T of one observation, transposed, in its slot; and its part of the right side."""
    x, y, z = system.in_camera[o, 0], system.in_camera[o, 1], system.in_camera[o, 2]
    root, coupling, rhs = system.point_root[j], system.coupling[o], system.point_rhs[j]
    l00, l10, l11, l20, l21, l22 = root[0], root[1], root[2], root[3], root[4], root[5]
    b00, b01, b02 = coupling[0, 0], coupling[0, 1], coupling[0, 2]
    b10, b11, b12 = coupling[1, 0], coupling[1, 1], coupling[1, 2]
    b20, b21, b22 = coupling[2, 0], coupling[2, 1], coupling[2, 2]
    m00, m10, m20 = b00 * l00, b10 * l00, b20 * l00
    m01, m11, m21 = b00 * l10 + b01 * l11, b10 * l10 + b11 * l11, b20 * l10 + b21 * l11
    m02 = b00 * l20 + b01 * l21 + b02 * l22
    m12 = b10 * l20 + b11 * l21 + b12 * l22
    m22 = b20 * l20 + b21 * l21 + b22 * l22
    m30, m40, m50 = y * m20 - z * m10, z * m00 - x * m20, x * m10 - y * m00
    m31, m41, m51 = y * m21 - z * m11, z * m01 - x * m21, x * m11 - y * m01
    m32, m42, m52 = y * m22 - z * m12, z * m02 - x * m22, x * m12 - y * m02

    columns = system.elimination[:, COLUMN * slot : COLUMN * slot + POSE]
    columns[0, 0], columns[0, 1], columns[0, 2] = m00, m10, m20
    columns[0, 3], columns[0, 4], columns[0, 5] = m30, m40, m50
    columns[1, 0], columns[1, 1], columns[1, 2] = m01, m11, m21
    columns[1, 3], columns[1, 4], columns[1, 5] = m31, m41, m51
    columns[2, 0], columns[2, 1], columns[2, 2] = m02, m12, m22
    columns[2, 3], columns[2, 4], columns[2, 5] = m32, m42, m52
    r0, r1, r2 = rhs[0], rhs[1], rhs[2]
    step = system.camera_step[observations.free_camera[o]]
    step[0] += m00 * r0 + m01 * r1 + m02 * r2
    step[1] += m10 * r0 + m11 * r1 + m12 * r2
    step[2] += m20 * r0 + m21 * r1 + m22 * r2
    step[3] += m30 * r0 + m31 * r1 + m32 * r2
    step[4] += m40 * r0 + m41 * r1 + m42 * r2
    step[5] += m50 * r0 + m51 * r1 + m52 * r2


@compiled
def back_substitute(observations, system):
    """The step of every free point from the step of the cameras, by how far those move it in each of them."""
    for j in range(len(observations.point_is_free)):
        step = system.point_step[j]
        if not observations.point_is_free[j]:
            step[0] = step[1] = step[2] = 0.0
            continue
        g0, g1, g2 = system.point_gradient[j, 0], system.point_gradient[j, 1], system.point_gradient[j, 2]
        for o in range(observations.first[j], observations.first_fixed[j]):
            x, y, z = system.in_camera[o, 0], system.in_camera[o, 1], system.in_camera[o, 2]
            camera_step, coupling = system.camera_step[observations.free_camera[o]], system.coupling[o]
            d0 = camera_step[0] + camera_step[4] * z - camera_step[5] * y
            d1 = camera_step[1] + camera_step[5] * x - camera_step[3] * z
            d2 = camera_step[2] + camera_step[3] * y - camera_step[4] * x
            g0 += coupling[0, 0] * d0 + coupling[1, 0] * d1 + coupling[2, 0] * d2
            g1 += coupling[0, 1] * d0 + coupling[1, 1] * d1 + coupling[2, 1] * d2
            g2 += coupling[0, 2] * d0 + coupling[1, 2] * d1 + coupling[2, 2] * d2
        root = system.point_root[j]
        s0, s1, s2 = root[0] * g0, root[1] * g0 + root[2] * g1, root[3] * g0 + root[4] * g1 + root[5] * g2
        step[0] = -(root[0] * s0 + root[1] * s1 + root[3] * s2)
        step[1] = -(root[2] * s1 + root[4] * s2)
        step[2] = -(root[5] * s2)
