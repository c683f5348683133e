"""Keypoints of the network moved to the exact position of the corner in the image.

A heat map of 8×8 cells is accurate to about a pixel after long training, and worse after a short one; image gradients
are accurate to a fraction of a pixel. Each keypoint goes to the largest smaller eigenvalue of the structure tensor (Shi
and Tomasi, 1994) around it, weighted towards the network's position, and to the peak of a parabola through it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from improvo.compiled import compiled
from improvo.types import Float32

_EDGE = 3  # pixels of the image that a response needs around its own: smoothing, gradient and 3×3 window
_LEAST_RESPONSE = 1.5e-5  # of the eigenvalue: below it, about one grey level of 256 squared, there is only noise


def refine_to_corners(image: Float32, keypoints: Float32, radius: int) -> tuple[Float32, NDArray[np.bool_]]:
    """Keypoints (N, 2) at the best corner at most `radius` pixels away in x and y; those without one stay.

    Args:
        image: (H, W) grey in [0, 1].
        keypoints: (N, 2) x, y in pixels.

    Returns:
        The keypoints, and whether there is a corner (N,). Where there is none, as where the picture is saturated, a
        network can still see keypoints, at the same place in each of its cells; they move with the camera.
    """
    if not len(keypoints):
        return keypoints, np.zeros(0, np.bool_)
    steps = np.arange(-radius, radius + 1)
    falloff = np.exp(-(steps[:, None] ** 2 + steps**2) / (2 * (radius / 1.5) ** 2)).astype(np.float32)
    image = np.ascontiguousarray(image, np.float32)
    moved, found = move_to_corners(image, np.ascontiguousarray(keypoints, np.float32), radius, falloff)
    return moved, found


@compiled
def move_to_corners(image, keypoints, radius, falloff):  # type: ignore[no-untyped-def]
    height, width = image.shape
    reach = radius + 1  # the parabola needs the neighbours of the best
    side = 2 * (reach + _EDGE) + 1
    count = 2 * reach + 1
    patch = np.empty((side, side), np.float32)
    across = np.empty((side, side - 2), np.float32)
    smooth = np.empty((side - 2, side - 2), np.float32)
    xx = np.empty((side - 4, side - 4), np.float32)
    yy, xy = np.empty_like(xx), np.empty_like(xx)
    response = np.empty((count, count), np.float32)
    result = keypoints.copy()
    found = np.zeros(len(keypoints), np.bool_)
    quarter, half = np.float32(0.25), np.float32(0.5)
    for n in range(len(keypoints)):
        x0, y0 = round(keypoints[n, 0]), round(keypoints[n, 1])
        left, top = x0 - reach - _EDGE, y0 - reach - _EDGE
        for i in range(side):  # the image is repeated beyond its edges
            y = min(max(top + i, 0), height - 1)
            for j in range(side):
                patch[i, j] = image[y, min(max(left + j, 0), width - 1)]
        for i in range(side):  # binomial smoothing, 3×3
            for j in range(side - 2):
                across[i, j] = quarter * (patch[i, j] + patch[i, j + 2]) + half * patch[i, j + 1]
        for i in range(side - 2):
            for j in range(side - 2):
                smooth[i, j] = quarter * (across[i, j] + across[i + 2, j]) + half * across[i + 1, j]
        for i in range(side - 4):
            for j in range(side - 4):
                gx = half * (smooth[i + 1, j + 2] - smooth[i + 1, j])
                gy = half * (smooth[i + 2, j + 1] - smooth[i, j + 1])
                xx[i, j], yy[i, j], xy[i, j] = gx * gx, gy * gy, gx * gy
        best, row, column = np.float32(0), -1, -1
        for i in range(count):
            for j in range(count):
                a, b, c = np.float32(0), np.float32(0), np.float32(0)
                for v in range(3):
                    a += xx[i + v, j] + xx[i + v, j + 1] + xx[i + v, j + 2]
                    b += xy[i + v, j] + xy[i + v, j + 1] + xy[i + v, j + 2]
                    c += yy[i + v, j] + yy[i + v, j + 1] + yy[i + v, j + 2]
                response[i, j] = half * (a + c) - np.sqrt(quarter * (a - c) * (a - c) + b * b)
        for i in range(1, count - 1):
            for j in range(1, count - 1):
                value = response[i, j] * falloff[i - 1, j - 1]
                if value <= best or response[i, j] <= _LEAST_RESPONSE:
                    continue
                x, y = x0 + j - reach, y0 + i - reach
                if 1 <= x <= width - 2 and 1 <= y <= height - 2:
                    best, row, column = value, i, j
        if row < 0:
            continue
        found[n] = True
        middle = response[row, column]
        result[n, 0] = x0 + column - reach + _peak(response[row, column - 1], middle, response[row, column + 1])
        result[n, 1] = y0 + row - reach + _peak(response[row - 1, column], middle, response[row + 1, column])
    return result, found


@compiled
def _peak(before, middle, after):  # type: ignore[no-untyped-def]
    """Where, at most half a pixel away, the parabola through three values is largest; 0 if the middle is no maximum."""
    bend = before - 2 * middle + after
    if bend >= 0 or max(before, after) > 1.001 * middle:  # equal but for rounding: the peak is half-way
        return 0.0
    return min(max(0.5 * (before - after) / bend, -0.5), 0.5)
