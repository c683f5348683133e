"""The compiled parts of `improvo.depth.plane_sweep`.

A plane at inverse depth w carries pixel p of the frame to A p + w b of a neighbour. The sums of ZNCC over a window are
running sums over rows. Grey values are multiples of a quarter between -128 and 127.75, scaled by 4, so that every sum
is a whole number below 2^24: float32 holds them exactly, and running sums do not drift.
"""
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

import math

import numpy as np

from improvo.compiled import compiled

RADIUS = 3  # of the window: 7 x 7
WINDOW = 2 * RADIUS + 1
LEVELS = 4  # steps per grey level
_AREA = np.float32(WINDOW * WINDOW)
_CENTRE = np.float32(128 * LEVELS)
_ZERO, _HALF, _ONE, _TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
_LEVELS = np.float32(LEVELS)
_OUTSIDE = np.float32(-2)  # score of a place that a neighbour does not show
_UNKNOWN = np.float32(-1)
_BYTE = np.uint32(255)
_LEAST_VIEWS = np.float32(1.5)


@compiled
def sweep(values, sums, inverse_spread, packed, A, b, inverse_depths, better, volume):
    """Fill `volume` (D, H, W) with the mean ZNCC over the better neighbours of each pixel at each plane.

    -1 where fewer than two neighbours (or than one, if there is only one) show the place, or at the border.

    Args:
        values: (H, W) float32 frame.
        sums: (H, W) float32 sum of `values` over each window.
        inverse_spread: (H, W) float32 1 / sqrt(area * sum of squares - sum^2).
        packed: (N, H * W) uint32 neighbours, four bytes a pixel: it, right of it, below it, right below it.
        A: (N, 3, 3) and b (N, 3) float64.
        inverse_depths: (D,) float64.
        better: how many of the neighbours count.
    """
    neighbours = len(packed)
    height, width = values.shape
    ring = np.zeros((neighbours, WINDOW, width), np.float32)
    inside = np.zeros((neighbours, WINDOW, width), np.float32)
    columns = np.zeros((neighbours, 3, width), np.float32)
    boxes = np.zeros((3, width), np.float32)
    u, v, score = np.zeros(width, np.float32), np.zeros(width, np.float32), np.zeros(width, np.float32)
    four = np.zeros(width, np.uint32)
    top = np.zeros((better, width), np.float32)
    least = _HALF if neighbours == 1 else _LEAST_VIEWS
    inner = width - 2 * RADIUS
    for d in range(len(inverse_depths)):
        columns[:] = _ZERO
        for new in range(height):
            y = new - RADIUS
            slot = new % WINDOW
            top[:] = _OUTSIDE
            for n in range(neighbours):
                if new >= WINDOW:
                    _remove(ring[n, slot], values[new - WINDOW], columns[n, 0], columns[n, 1], columns[n, 2])
                _locate(A[n], b[n], inverse_depths[d], new, height, inside[n, slot], u, v)
                _look_up(packed[n], u, v, four)
                _interpolate(four, u, v, ring[n, slot])
                _add(ring[n, slot], values[new], columns[n, 0], columns[n, 1], columns[n, 2])
                if y < RADIUS:
                    continue
                for k in range(3):
                    _box(columns[n, k], boxes[k], score)
                _correlate(
                    boxes[0, :inner], boxes[1, :inner], boxes[2, :inner], sums[y, RADIUS : width - RADIUS],
                    inverse_spread[y, RADIUS : width - RADIUS], inside[n, y % WINDOW, RADIUS : width - RADIUS],
                    score[:inner],
                )  # fmt: skip
                for k in range(better):
                    _insert(top[k], score)
            if y >= RADIUS:
                _mean_of_better(top, least, volume[d, y, RADIUS : width - RADIUS])


@compiled
def _locate(A, b, inverse_depth, y, height, inside, u, v):
    """Where a row of the frame lies in the neighbour, and whether it shows that."""
    a0, a1, a2 = np.float32(A[0, 0]), np.float32(A[1, 0]), np.float32(A[2, 0])
    c0 = np.float32(A[0, 1] * y + A[0, 2] + inverse_depth * b[0])
    c1 = np.float32(A[1, 1] * y + A[1, 2] + inverse_depth * b[1])
    c2 = np.float32(A[2, 1] * y + A[2, 2] + inverse_depth * b[2])
    last_x, last_y = np.float32(len(u) - 1.001), np.float32(height - 1.001)
    for x in range(len(u)):
        column = np.float32(np.int32(x))
        scale = _ONE / (a2 * column + c2)
        p, q = (a0 * column + c0) * scale, (a1 * column + c1) * scale
        shown = (scale > _ZERO) & (p >= _ZERO) & (p <= last_x) & (q >= _ZERO) & (q <= last_y)
        inside[x] = _ONE if shown else _ZERO
        u[x] = p if shown else _ZERO
        v[x] = q if shown else _ZERO


@compiled
def _look_up(packed, u, v, four):
    width = np.uint32(len(u))
    for x in range(len(u)):
        four[x] = packed[np.uint32(np.int32(v[x])) * width + np.uint32(np.int32(u[x]))]


@compiled
def _interpolate(four, u, v, row):
    """Bilinear, rounded to a multiple of 1 / LEVELS, less the middle grey, times LEVELS."""
    for x in range(len(row)):
        right, down = u[x] - np.float32(np.int32(u[x])), v[x] - np.float32(np.int32(v[x]))
        bytes4 = four[x]
        a = np.float32(np.int32(bytes4 & _BYTE))
        b = np.float32(np.int32((bytes4 >> np.uint32(8)) & _BYTE))
        c = np.float32(np.int32((bytes4 >> np.uint32(16)) & _BYTE))
        d = np.float32(np.int32(bytes4 >> np.uint32(24)))
        above, below = a + right * (b - a), c + right * (d - c)
        value = above + down * (below - above)
        row[x] = np.float32(np.int32(value * _LEVELS + _HALF)) - _CENTRE


@compiled
def _add(row, values, total, squares, products):
    for x in range(len(row)):
        new = row[x]
        total[x] += new
        squares[x] += new * new
        products[x] += new * values[x]


@compiled
def _remove(row, values, total, squares, products):
    for x in range(len(row)):
        old = row[x]
        total[x] -= old
        squares[x] -= old * old
        products[x] -= old * values[x]


@compiled
def _box(columns, box, scratch):
    """box[x] = columns[x] + ... + columns[x + 6]."""
    size = len(columns)
    for x in range(size - 1):
        scratch[x] = columns[x] + columns[x + 1]
    for x in range(size - 3):
        box[x] = scratch[x] + scratch[x + 2]
    for x in range(size - 6):
        box[x] = box[x] + scratch[x + 4] + columns[x + 6]


@compiled
def _correlate(total, squares, products, sums, inverse_spread, inside, score):
    for x in range(len(score)):
        variance = _AREA * squares[x] - total[x] * total[x]
        variance = variance if variance > _ONE else _ONE
        zncc = (_AREA * products[x] - total[x] * sums[x]) * inverse_spread[x] / np.float32(math.sqrt(variance))
        score[x] = zncc if inside[x] > _HALF else _OUTSIDE


@compiled
def _insert(best, score):
    """Keep the larger, pass the smaller on."""
    for x in range(len(best)):
        a, b = best[x], score[x]
        best[x] = a if a > b else b
        score[x] = b if a > b else a


@compiled
def _mean_of_better(top, least, mean):
    for x in range(len(mean)):
        total, count = _ZERO, _ZERO
        for k in range(len(top)):
            if top[k, x] > _OUTSIDE:
                total += top[k, x]
                count += _ONE
        mean[x] = total / count if count > least else _UNKNOWN


@compiled
def pick(volume, inverse_spread, inverse_depths, max_inverse_spread, min_score, max_second, depth, confidence):
    """The depth of the best plane of each pixel, moved by the parabola through it and its neighbours.

    Unknown (0) where the texture is too weak, the score too low, the best plane the first or the last, or where a
    plane more than two away scores nearly as well.
    """
    planes, height, width = volume.shape
    step = (inverse_depths[planes - 1] - inverse_depths[0]) / (planes - 1)
    best = np.zeros(width, np.float32)
    best_plane = np.zeros(width, np.int32)
    for y in range(RADIUS, height - RADIUS):
        best[:] = _OUTSIDE
        for d in range(planes):
            _keep_best(volume[d, y], np.int32(d), best, best_plane)
        for x in range(RADIUS, width - RADIUS):
            d = best_plane[x]
            if d == 0 or d == planes - 1 or not best[x] >= min_score or inverse_spread[y, x] > max_inverse_spread:
                continue
            before, after = volume[d - 1, y, x], volume[d + 1, y, x]
            if min(before, after) <= _UNKNOWN:
                continue
            second = _second_peak(volume, y, x, d)
            ratio = (_ONE - best[x]) / (_ONE - second)
            if ratio > max_second:
                continue
            bend = before - _TWO * best[x] + after
            move = _HALF * (before - after) / bend if bend < _ZERO else _ZERO
            depth[y, x] = np.float32(1.0 / (inverse_depths[d] + step * move))
            confidence[y, x] = best[x] * (_ONE - ratio)


@compiled
def _keep_best(scores, plane, best, best_plane):
    for x in range(len(best)):
        better = scores[x] > best[x]
        best_plane[x] = plane if better else best_plane[x]
        best[x] = scores[x] if better else best[x]


@compiled
def _second_peak(volume, y, x, d):
    """The best local maximum among the planes that are not next to plane d."""
    planes = len(volume)
    second = _UNKNOWN
    for other in range(planes):
        if abs(other - d) <= 2 or volume[other, y, x] <= second:
            continue
        left = volume[other - 1, y, x] if other > 0 else _UNKNOWN
        right = volume[other + 1, y, x] if other < planes - 1 else _UNKNOWN
        if volume[other, y, x] >= left and volume[other, y, x] >= right:
            second = volume[other, y, x]
    return second
