"""Keypoints moved to the corner that they stand for: the network says where to look, the image says where exactly.

A heat map of 8×8 cells is sharp to about a pixel after long training and to less after a short one; the image's own
gradients are sharp to a fraction of that. Each keypoint goes to the largest smaller eigenvalue of the structure tensor
(Shi and Tomasi, 1994) around it, weighted towards where the network put it, and to the peak of a parabola through it.
"""

from __future__ import annotations

import numba
import numpy as np

from sivo.types import Float32

_EDGE = 3  # pixels of the image that a response needs around its own: smoothing, gradient and 3×3 window
_LEAST_RESPONSE = 1.5e-5  # of the eigenvalue: below it, about one grey level of 256 squared, there is only noise


def refine_to_corners(image: Float32, keypoints: Float32, radius: int) -> Float32:
    """Keypoints (N, 2) at the best corner at most `radius` pixels away in x and y; those without one stay.

    Args:
        image: (H, W) grey in [0, 1].
        keypoints: (N, 2) x, y in pixels.
    """
    if not len(keypoints):
        return keypoints
    return np.asarray(
        _refine(np.ascontiguousarray(image, np.float32), np.ascontiguousarray(keypoints, np.float32), radius)
    )


@numba.njit(cache=True, nogil=True)
def _refine(image, keypoints, radius):  # type: ignore[no-untyped-def]
    height, width = image.shape
    reach = radius + 1  # the parabola needs the neighbours of the best
    side = 2 * (reach + _EDGE) + 1
    smooth = np.empty((side, side), np.float32)
    xx, yy, xy = np.empty_like(smooth), np.empty_like(smooth), np.empty_like(smooth)
    count = 2 * reach + 1
    response = np.empty((count, count), np.float32)
    falloff = 1.0 / (2.0 * (radius / 1.5) ** 2)
    result = keypoints.copy()
    for n in range(len(keypoints)):
        x0, y0 = round(keypoints[n, 0]), round(keypoints[n, 1])
        for i in range(side):  # 3×3 binomial smoothing, the image repeated beyond its edges
            for j in range(side):
                total = np.float32(0)
                for v in range(-1, 2):
                    y = min(max(y0 - reach - _EDGE + i + v, 0), height - 1)
                    for u in range(-1, 2):
                        x = min(max(x0 - reach - _EDGE + j + u, 0), width - 1)
                        total += image[y, x] * np.float32((2 - abs(u)) * (2 - abs(v)))
                smooth[i, j] = total / 16
        for i in range(1, side - 1):
            for j in range(1, side - 1):
                gx, gy = 0.5 * (smooth[i, j + 1] - smooth[i, j - 1]), 0.5 * (smooth[i + 1, j] - smooth[i - 1, j])
                xx[i, j], yy[i, j], xy[i, j] = gx * gx, gy * gy, gx * gy
        best, row, column = 0.0, -1, -1
        for i in range(count):
            for j in range(count):
                a, b, c = 0.0, 0.0, 0.0
                for v in range(i + _EDGE - 1, i + _EDGE + 2):
                    for u in range(j + _EDGE - 1, j + _EDGE + 2):
                        a += xx[v, u]
                        b += xy[v, u]
                        c += yy[v, u]
                response[i, j] = 0.5 * (a + c) - np.sqrt(0.25 * (a - c) ** 2 + b * b)
                dx, dy = j - reach, i - reach
                y, x = y0 + dy, x0 + dx
                if abs(dx) > radius or abs(dy) > radius or x < 1 or y < 1 or x > width - 2 or y > height - 2:
                    continue
                value = response[i, j] * np.exp(-falloff * (dx * dx + dy * dy))
                if response[i, j] > _LEAST_RESPONSE and value > best:
                    best, row, column = value, i, j
        if row < 0:
            continue
        middle = response[row, column]
        result[n, 0] = x0 + column - reach + _peak(response[row, column - 1], middle, response[row, column + 1])
        result[n, 1] = y0 + row - reach + _peak(response[row - 1, column], middle, response[row + 1, column])
    return result


@numba.njit(cache=True, nogil=True)
def _peak(before, middle, after):  # type: ignore[no-untyped-def]
    """Where, between -0.5 and 0.5, the parabola through three values is largest; 0 if the middle is no maximum."""
    bend = before - 2 * middle + after
    if bend >= 0 or middle < before or middle < after:
        return 0.0
    return 0.5 * (before - after) / bend
