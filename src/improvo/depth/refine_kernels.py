"""The compiled parts of `improvo.depth.refine`: surfaces through the pixels around, and Gauss-Newton steps."""
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

import math

import numpy as np

from improvo.compiled import compiled
from improvo.depth.sweep_kernels import RADIUS, WINDOW

_FIT_RADIUS = 4
_LEAST_FIT = 12  # pixels of a surface
_LEAST_SHARE = 0.5  # of a window, that two frames must share
_SUMS = 10


@compiled
def fit_surfaces(inverse_depth, same_surface, fitted):
    """Fill `fitted` (h, w) with the inverse depth at each known pixel of the plane through the pixels around it.

    The inverse depth of a plane is linear in the pixels. Only pixels within the relative difference `same_surface`
    belong to the same plane; where they are too few, the pixel keeps its own inverse depth.
    """
    height, width = inverse_depth.shape
    for y in range(height):
        for x in range(width):
            w0 = inverse_depth[y, x]
            fitted[y, x] = w0
            if w0 <= 0.0:
                continue
            count = sx = sy = sxx = sxy = syy = s = sxw = syw = 0.0
            for dy in range(max(-_FIT_RADIUS, -y), min(_FIT_RADIUS, height - 1 - y) + 1):
                for dx in range(max(-_FIT_RADIUS, -x), min(_FIT_RADIUS, width - 1 - x) + 1):
                    d = inverse_depth[y + dy, x + dx] - w0
                    if abs(d) <= same_surface * w0:
                        count += 1.0
                        sx += dx
                        sy += dy
                        sxx += dx * dx
                        sxy += dx * dy
                        syy += dy * dy
                        s += d
                        sxw += dx * d
                        syw += dy * d
            if count < _LEAST_FIT:
                continue
            a, b, c = sxx - sx * sx / count, sxy - sx * sy / count, syy - sy * sy / count
            p, q = sxw - sx * s / count, syw - sy * s / count
            determinant = a * c - b * b
            if determinant > 0.01 * a * c:
                to_right, downwards = (c * p - b * q) / determinant, (a * q - b * p) / determinant
                fitted[y, x] = w0 + (s - to_right * sx - downwards * sy) / count


@compiled
def measure(values, packed, A, b, inverse_depth, score, up, down):
    """Compare the windows of a frame with those of a neighbour, each pixel at its own inverse depth.

    Args:
        values: (h, w) float32 frame.
        packed: (h * w,) uint32 neighbour, four bytes a pixel.
        A: (3, 3) and b (3,): pixel p at inverse depth w falls on A p + w b.
        inverse_depth: (h, w) float64, 0 where unknown; these pixels do not count.
        score: (h, w) float32, filled: ZNCC, -2 where the frames share too little of the window.
        up: (h, w) float32, filled with the Gauss-Newton step's numerator.
        down: (h, w) float32, filled with its denominator.
    """
    height, width = values.shape
    rows = np.zeros((WINDOW, _SUMS, width))  # what each of the last rows adds to the sums
    columns = np.zeros((_SUMS, width))
    total = np.zeros(_SUMS)
    score[:] = np.float32(-2)
    for new in range(height):
        slot = new % WINDOW
        for k in range(_SUMS):
            for x in range(width):
                columns[k, x] -= rows[slot, k, x]
        _warp_row(values[new], packed, A, b, new, height, inverse_depth[new], rows[slot])
        for k in range(_SUMS):
            for x in range(width):
                columns[k, x] += rows[slot, k, x]
        y = new - RADIUS
        if y < RADIUS:
            continue
        total[:] = 0.0
        for k in range(_SUMS):
            for x in range(WINDOW - 1):
                total[k] += columns[k, x]
        for x in range(RADIUS, width - RADIUS):
            for k in range(_SUMS):
                total[k] += columns[k, x + RADIUS]
            if inverse_depth[y, x] > 0.0 and total[0] >= _LEAST_SHARE * WINDOW * WINDOW:
                _step(total, score, up, down, y, x)
            for k in range(_SUMS):
                total[k] -= columns[k, x - RADIUS]


@compiled
def _warp_row(values, packed, A, b, y, height, inverse_depth, sums):
    """What one row adds to the window sums: 1, r, r^2, v, v^2, r v, s, s^2, s v, s r.

    r is the frame's grey value, v the neighbour's where the pixel falls, s how v changes with the inverse depth.
    """
    width = len(values)
    for x in range(width):
        w = inverse_depth[x]
        z = A[2, 0] * x + A[2, 1] * y + A[2, 2] + w * b[2]
        inside = w > 0.0 and z > 0.0
        u = v = 0.0
        if inside:
            u = (A[0, 0] * x + A[0, 1] * y + A[0, 2] + w * b[0]) / z
            v = (A[1, 0] * x + A[1, 1] * y + A[1, 2] + w * b[1]) / z
            inside = u >= 0.0 and v >= 0.0 and u < width - 1 and v < height - 1
        if not inside:
            sums[:, x] = 0.0
            continue
        column, row = int(u), int(v)
        right, below = u - column, v - row
        bytes4 = packed[row * width + column]
        p00, p01 = float(bytes4 & 255), float((bytes4 >> 8) & 255)
        p10, p11 = float((bytes4 >> 16) & 255), float(bytes4 >> 24)
        above_value, below_value = p00 + right * (p01 - p00), p10 + right * (p11 - p10)
        value = above_value + below * (below_value - above_value)
        to_right = (p01 - p00) + below * ((p11 - p10) - (p01 - p00))
        slope = (to_right * (b[0] - u * b[2]) + (below_value - above_value) * (b[1] - v * b[2])) / z
        own = float(values[x])
        sums[0, x] = 1.0
        sums[1, x] = own
        sums[2, x] = own * own
        sums[3, x] = value
        sums[4, x] = value * value
        sums[5, x] = own * value
        sums[6, x] = slope
        sums[7, x] = slope * slope
        sums[8, x] = slope * value
        sums[9, x] = slope * own


@compiled
def _step(total, score, up, down, y, x):
    count = total[0]
    own, value = total[2] - total[1] * total[1] / count, total[4] - total[3] * total[3] / count
    if not (own > 1e-3 and value > 1e-3):
        return
    both = total[5] - total[1] * total[3] / count
    slopes = total[7] - total[6] * total[6] / count
    slope_value = total[8] - total[6] * total[3] / count
    slope_own = total[9] - total[6] * total[1] / count
    scale = 1.0 / math.sqrt(own * value)
    score[y, x] = np.float32(both * scale)
    up[y, x] = np.float32(slope_own * scale - slope_value / value)
    down[y, x] = np.float32(slopes / value)


@compiled
def move(fitted, scores, ups, downs, better, max_step, moved, mean_score):
    """Fill `moved` with the inverse depths after a step over the better neighbours of each pixel, and their mean ZNCC.

    Args:
        fitted: (h, w) float64.
        scores: (N, h, w) float32, and likewise ups and downs.
        ups: of `measure`.
        downs: of `measure`.
        better: how many neighbours count.
        max_step: largest step, relative to the inverse depth.
        moved: (h, w) float64, filled; 0 where no neighbour shows the pixel.
        mean_score: (h, w) float32, filled.
    """
    count, height, width = scores.shape
    used = np.zeros(count, np.bool_)
    for y in range(height):
        for x in range(width):
            w = fitted[y, x]
            moved[y, x] = 0.0
            if w <= 0.0:
                continue
            used[:] = False
            total = up = down = 0.0
            number = 0
            for _ in range(better):
                best = -1
                for n in range(count):
                    if not used[n] and scores[n, y, x] > -1.5 and (best < 0 or scores[n, y, x] > scores[best, y, x]):
                        best = n
                if best < 0:
                    break
                used[best] = True
                number += 1
                total += scores[best, y, x]
                up += ups[best, y, x]
                down += downs[best, y, x]
            if number == 0 or not down > 0.0:
                continue
            limit = max_step * w
            moved[y, x] = w + min(max(up / down, -limit), limit)
            mean_score[y, x] = np.float32(total / number)
