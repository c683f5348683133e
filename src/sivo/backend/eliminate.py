"""The Schur complement over the points: each free point is a 3x3 block that is eliminated in closed form.

With V = L L^T the damped block of a point and W its coupling with a camera, Y = W L^-T gives all that is needed:

    reduced system    S = U - sum Y Y^T,     right side  -(g_c - sum Y L^-1 g_p)
    back-substitution dX = -L^-T (L^-1 g_p + sum Y^T dc)
"""
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

import math

from numba import njit


@njit(cache=True, nogil=True)
def eliminate(observations, system, damping, min_diagonal):
    """Fill the reduced system and its right side (in `camera_step`); False where a block is not positive definite."""
    system.reduced[:] = 0.0
    for camera in range(len(observations.camera_of_free)):
        _start_block(system, camera, damping, min_diagonal)
    for j in range(len(observations.point_is_free)):
        if not observations.point_is_free[j]:
            continue
        if not _invert_root(system, j, damping, min_diagonal):
            return False
        first, last = observations.first[j], observations.first_constant[j]
        for a in range(first, last):
            _couple(observations, system, j, a)
        for a in range(first, last):
            for b in range(a, last):
                camera_a, camera_b = observations.free_camera[a], observations.free_camera[b]
                _subtract_product(system.reduced[camera_a, camera_b], system.elimination[a], system.elimination[b])
                if camera_a == camera_b and a != b:  # a camera that saw the point twice
                    _subtract_product(system.reduced[camera_a, camera_b], system.elimination[b], system.elimination[a])
    return True


@njit(cache=True, nogil=True)
def _start_block(system, camera, damping, min_diagonal):
    """The camera's own block, damped, and minus its gradient."""
    block, hessian = system.reduced[camera, camera], system.camera_hessian[camera]
    for i in range(6):
        for k in range(i, 6):
            block[i, k] = hessian[i, k]
        block[i, i] += damping * max(hessian[i, i], min_diagonal)
        system.camera_step[camera, i] = -system.camera_gradient[camera, i]


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _couple(observations, system, j, o):
    """Y = (I; [x]) A R L^-T of one observation, by columns, and its part of the right side."""
    x, y, z = system.in_camera[o, 0], system.in_camera[o, 1], system.in_camera[o, 2]
    root, coupling, rhs = system.point_root[j], system.coupling[o], system.point_rhs[j]
    step = system.camera_step[observations.free_camera[o]]
    for k in range(3):
        if k == 0:
            m0, m1, m2 = coupling[0, 0] * root[0], coupling[1, 0] * root[0], coupling[2, 0] * root[0]
        elif k == 1:
            m0 = coupling[0, 0] * root[1] + coupling[0, 1] * root[2]
            m1 = coupling[1, 0] * root[1] + coupling[1, 1] * root[2]
            m2 = coupling[2, 0] * root[1] + coupling[2, 1] * root[2]
        else:
            m0 = coupling[0, 0] * root[3] + coupling[0, 1] * root[4] + coupling[0, 2] * root[5]
            m1 = coupling[1, 0] * root[3] + coupling[1, 1] * root[4] + coupling[1, 2] * root[5]
            m2 = coupling[2, 0] * root[3] + coupling[2, 1] * root[4] + coupling[2, 2] * root[5]
        m3, m4, m5 = y * m2 - z * m1, z * m0 - x * m2, x * m1 - y * m0
        column = system.elimination[o, k]
        column[0], column[1], column[2], column[3], column[4], column[5] = m0, m1, m2, m3, m4, m5
        step[0] += m0 * rhs[k]
        step[1] += m1 * rhs[k]
        step[2] += m2 * rhs[k]
        step[3] += m3 * rhs[k]
        step[4] += m4 * rhs[k]
        step[5] += m5 * rhs[k]


@njit(cache=True, nogil=True)
def _subtract_product(block, columns_a, columns_b):
    """block -= Y_a Y_b^T, a row at a time over the padded width: half of the solver's time is spent here."""
    for i in range(6):
        a0, a1, a2 = columns_a[0, i], columns_a[1, i], columns_a[2, i]
        for k in range(8):
            block[i, k] -= a0 * columns_b[0, k] + a1 * columns_b[1, k] + a2 * columns_b[2, k]


@njit(cache=True, nogil=True)
def back_substitute(observations, system):
    """The step of every free point from the step of the cameras."""
    for j in range(len(observations.point_is_free)):
        step = system.point_step[j]
        if not observations.point_is_free[j]:
            step[0] = step[1] = step[2] = 0.0
            continue
        s0, s1, s2 = system.point_rhs[j, 0], system.point_rhs[j, 1], system.point_rhs[j, 2]
        for o in range(observations.first[j], observations.first_constant[j]):
            columns, camera_step = system.elimination[o], system.camera_step[observations.free_camera[o]]
            for i in range(6):
                s0 += columns[0, i] * camera_step[i]
                s1 += columns[1, i] * camera_step[i]
                s2 += columns[2, i] * camera_step[i]
        root = system.point_root[j]
        step[0] = -(root[0] * s0 + root[1] * s1 + root[3] * s2)
        step[1] = -(root[2] * s1 + root[4] * s2)
        step[2] = -(root[5] * s2)
