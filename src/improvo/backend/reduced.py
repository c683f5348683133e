"""The reduced system of the cameras: a dense Cholesky factorisation in place, six rows (one camera) at a time.

It is our own code because the result must not depend on the number of BLAS threads. At the size of a window (180
unknowns) it is as fast as LAPACK.
"""
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

import math

from improvo.backend.arrange import COLUMN, POSE, STRIDE
from improvo.backend.eliminate import back_substitute, block_start, chunk_end, subtract_rank_3
from improvo.compiled import compiled


@compiled
def solve_step(observations, system):
    """The step of cameras and points; False where S is singular.

    S = C^T C with C upper triangular: C replaces S, then C^T y = right side and C step = y, both in `camera_step`.
    """
    S, step = system.reduced, system.camera_step
    cameras = len(step)
    for camera in range(cameras):
        if not _factorise_rows(S, cameras, camera):
            return False
        for later in range(camera + 1, cameras):
            _update_rows(S, cameras, camera, later)
        _substitute_forwards(S, cameras, camera, step)
    for camera in range(cameras - 1, -1, -1):
        _substitute_backwards(S, cameras, camera, step)
    back_substitute(observations, system)
    return True


@compiled
def _factorise_rows(S, cameras, camera):
    """The six rows of C of one camera, from their diagonal block to the right edge."""
    corner = block_start(cameras, camera, camera)
    for i in range(POSE):
        for above in range(i):
            scale = S[corner + above * STRIDE + i]
            start = camera
            while start < cameras:
                end = chunk_end(start, cameras)
                row, width = block_start(cameras, camera, start), COLUMN * (end - start)
                target, source = row + i * STRIDE, row + above * STRIDE
                _subtract_scaled(S[target : target + width], scale, S[source : source + width])
                start = end
        pivot = S[corner + i * STRIDE + i]
        if not pivot > 0.0:
            return False
        scale = 1.0 / math.sqrt(pivot)
        start = camera
        while start < cameras:
            end = chunk_end(start, cameras)
            row = block_start(cameras, camera, start) + i * STRIDE
            for k in range(row, row + COLUMN * (end - start)):
                S[k] *= scale
            start = end
    return True


@compiled
def _update_rows(S, cameras, camera, later):
    """Take the finished rows of a camera from those of a later one."""
    column = block_start(cameras, camera, later)
    left = S.reshape(len(S) // STRIDE, STRIDE)[column // STRIDE :, column % STRIDE : column % STRIDE + POSE]
    start = later
    while start < cameras:
        end = chunk_end(start, cameras)
        width = COLUMN * (end - start)
        target = S[block_start(cameras, later, start) :]
        source = block_start(cameras, camera, start)
        for half in range(0, POSE, 3):
            right = source + half * STRIDE
            subtract_rank_3(
                target,
                left[half : half + 3],
                S[right : right + width],
                S[right + STRIDE : right + STRIDE + width],
                S[right + 2 * STRIDE : right + 2 * STRIDE + width],
            )
        start = end


@compiled
def _substitute_forwards(S, cameras, camera, step):
    """y of one camera, and its part taken from the right side of the later ones."""
    corner = block_start(cameras, camera, camera)
    for i in range(POSE):
        total = step[camera, i]
        for above in range(i):
            total -= S[corner + above * STRIDE + i] * step[camera, above]
        step[camera, i] = total / S[corner + i * STRIDE + i]
    for later in range(camera + 1, cameras):
        block = block_start(cameras, camera, later)
        for i in range(POSE):
            for k in range(POSE):
                step[later, k] -= S[block + i * STRIDE + k] * step[camera, i]


@compiled
def _substitute_backwards(S, cameras, camera, step):
    """The step of one camera, from those of the later ones."""
    for later in range(camera + 1, cameras):
        block = block_start(cameras, camera, later)
        for i in range(POSE):
            total = step[camera, i]
            for k in range(POSE):
                total -= S[block + i * STRIDE + k] * step[later, k]
            step[camera, i] = total
    corner = block_start(cameras, camera, camera)
    for i in range(POSE - 1, -1, -1):
        total = step[camera, i]
        for k in range(i + 1, POSE):
            total -= S[corner + i * STRIDE + k] * step[camera, k]
        step[camera, i] = total / S[corner + i * STRIDE + i]


@compiled
def _subtract_scaled(target, scale, source):
    for k in range(len(target)):
        target[k] -= scale * source[k]
