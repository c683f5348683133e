"""The reduced system of the cameras: a dense Cholesky factorisation of our own.

Ours because the result must not depend on how many threads a BLAS happens to use, and because at 180 unknowns the
block-wise update below is as fast as LAPACK's.
"""
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

import math

from numba import njit


@njit(cache=True, nogil=True)
def solve_reduced(system):
    """Overwrite `camera_step` (the right side) with the solution; False where S is not positive definite."""
    factor = system.factor
    cameras = len(system.camera_step)
    _unpack(system.reduced, factor, cameras)
    for camera in range(cameras):
        if not _factorise_panel(factor, 6 * camera):
            return False
        for row in range(6 * camera + 6, 6 * cameras):
            _update_row(factor, 6 * camera, row)
    _substitute(factor, system.camera_step.reshape(6 * cameras))
    return True


@njit(cache=True, nogil=True)
def _unpack(reduced, factor, cameras):
    """The upper triangle of the padded blocks as one matrix."""
    for a in range(cameras):
        for b in range(a, cameras):
            for i in range(6):
                for k in range(6):
                    factor[6 * a + i, 6 * b + k] = reduced[a, b, i, k]


@njit(cache=True, nogil=True)
def _factorise_panel(factor, start):
    """Cholesky of six rows, from their diagonal block to the right edge."""
    for i in range(start, start + 6):
        row = factor[i]
        for above in range(start, i):
            scale = factor[above, i]
            upper = factor[above]
            for k in range(i, len(row)):
                row[k] -= scale * upper[k]
        if not row[i] > 0.0:
            return False
        scale = 1.0 / math.sqrt(row[i])
        for k in range(i, len(row)):
            row[k] *= scale
    return True


@njit(cache=True, nogil=True)
def _update_row(factor, start, row):
    """Take six finished rows from a later one, all at once."""
    target = factor[row]
    r0, r1, r2 = factor[start], factor[start + 1], factor[start + 2]
    r3, r4, r5 = factor[start + 3], factor[start + 4], factor[start + 5]
    s0, s1, s2, s3, s4, s5 = r0[row], r1[row], r2[row], r3[row], r4[row], r5[row]
    for k in range(row, len(target)):
        target[k] -= s0 * r0[k] + s1 * r1[k] + s2 * r2[k] + s3 * r3[k] + s4 * r4[k] + s5 * r5[k]


@njit(cache=True, nogil=True)
def _substitute(factor, rhs):
    """Solve (factor^T factor) x = rhs in place, both sweeps along rows."""
    count = len(rhs)
    for i in range(count):
        rhs[i] /= factor[i, i]
        for k in range(i + 1, count):
            rhs[k] -= factor[i, k] * rhs[i]
    for i in range(count - 1, -1, -1):
        total = rhs[i]
        for k in range(i + 1, count):
            total -= factor[i, k] * rhs[k]
        rhs[i] = total / factor[i, i]
