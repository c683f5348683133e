"""The reduced system of the cameras: a dense Cholesky factorisation in place, six rows (one camera) at a time.

Our own, because the result must not depend on how many threads a BLAS happens to use, and because at the size of a
window (180 unknowns) it takes no longer than LAPACK does.
"""
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

import math

from sivo.backend.arrange import CHUNK, COLUMN, POSE, STRIDE
from sivo.backend.compiled import compiled
from sivo.backend.eliminate import block_start, subtract_rank_3


@compiled
def solve_reduced(system):
    """Overwrite `camera_step` (the right side) with the solution of S step = right side; False where S is singular.

    S = C^T C with C upper triangular: C replaces S, then C^T y = right side and C step = y.
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
                end = _chunk_end(start, cameras)
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
            end = _chunk_end(start, cameras)
            row = block_start(cameras, camera, start) + i * STRIDE
            for k in range(row, row + COLUMN * (end - start)):
                S[k] *= scale
            start = end
    return True


@compiled
def _update_rows(S, cameras, camera, later):
    """Take the finished rows of a camera from those of a later one."""
    left = _rows(S, block_start(cameras, camera, later), POSE)
    start = later
    while start < cameras:
        end = _chunk_end(start, cameras)
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
    corner = _rows(S, block_start(cameras, camera, camera), POSE)
    for i in range(POSE):
        for above in range(i):
            step[camera, i] -= corner[above, i] * step[camera, above]
        step[camera, i] /= corner[i, i]
    for later in range(camera + 1, cameras):
        block = _rows(S, block_start(cameras, camera, later), POSE)
        for i in range(POSE):
            for k in range(POSE):
                step[later, k] -= block[i, k] * step[camera, i]


@compiled
def _substitute_backwards(S, cameras, camera, step):
    """The step of one camera, from those of the later ones."""
    for later in range(camera + 1, cameras):
        block = _rows(S, block_start(cameras, camera, later), POSE)
        for i in range(POSE):
            for k in range(POSE):
                step[camera, i] -= block[i, k] * step[later, k]
    corner = _rows(S, block_start(cameras, camera, camera), POSE)
    for i in range(POSE - 1, -1, -1):
        for k in range(i + 1, POSE):
            step[camera, i] -= corner[i, k] * step[camera, k]
        step[camera, i] /= corner[i, i]


@compiled
def _rows(S, start, count):
    """The block that starts there, as `count` rows of six."""
    column = start % STRIDE
    first = start // STRIDE
    return S.reshape(len(S) // STRIDE, STRIDE)[first : first + count, column : column + POSE]


@compiled
def _chunk_end(start, cameras):
    """The first camera after `start` whose columns lie in another piece of the rows."""
    return min((start // CHUNK + 1) * CHUNK, cameras)


@compiled
def _subtract_scaled(target, scale, source):
    for k in range(len(target)):
        target[k] -= scale * source[k]
