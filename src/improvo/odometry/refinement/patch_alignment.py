"""Where a patch of an earlier picture lies in this one, to about a tenth of a pixel: least squares, gain and offset.

The patch is first warped into the geometry of the new picture. Then a translation is sought with the derivatives of
that template, which are computed once (the inverse compositional scheme, Baker and Matthews, 2004): the grey values of
the new picture are regressed on the template, a constant, and the template's derivatives by translation. Its
derivatives by the other four numbers of an affine warp are regressors too, with a ridge, so that a warp that was
predicted not quite rightly does not shift the patch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from improvo.compiled import compiled, inlined
from improvo.types import Float32, Float64, Mask, UInt8

REACH = 12  # pixels of a stored patch around its middle; a warp may look so far
_HALF = 4  # pixels of the aligned patch around its middle: 9x9
_SIGMA = 3.0  # pixels, of the patch's Gaussian weights
_RIDGE = 0.1  # of the affine regressors, as a share of the squared gradient
_COLUMNS = 8
_MAX_ITERATIONS = 15
_CONVERGED = 0.01  # pixels of the last step
_MIN_CONTRAST = 5.0  # grey levels, deviation of a patch: flatter ones have no place
_MIN_CORNER = 1e-3  # determinant over squared trace of the structure tensor: less is an edge
_MIN_GAIN = 0.2  # contrast of the new picture over the template's
_REPEATED = 0.95  # correlation of a patch with its own surroundings, from which its place is ambiguous
_NOT_FOUND = -2.0  # a correlation that there is not


@dataclass(frozen=True)
class Aligned:
    """Where patches were found."""

    places: Float64  # (N, 2) pixels; where it was not found, where the search began
    correlation: Float64  # (N,) of the grey values, weighted; below -1 where no place was found
    deviation: Float64  # (N,) pixels, standard deviation of the place, from the grey values' residuals


def align(
    image: UInt8, starts: Float64, patches: Float32, middles: Float64, patch_from_image: Float64, max_move: float
) -> Aligned:
    """Find patches near where they should be.

    Args:
        image: (H, W) grey.
        starts: (N, 2) pixels where each search begins.
        patches: (N, 2 REACH + 1, 2 REACH + 1) as `cut_patches` makes them.
        middles: (N, 2) x, y of the point within its patch.
        patch_from_image: (N, 2, 2) the warp around the point, from offsets in the image to offsets in the patch.
        max_move: pixels from the start, at most.
    """
    return Aligned(*align_patches(image, starts, patches, middles, patch_from_image, max_move))


@compiled
def cut_patches(image, centres):  # type: ignore[no-untyped-def]
    """Patches (N, 2 REACH + 1, 2 REACH + 1) around the pixels nearest to centres (N, 2); the edge is repeated."""
    height, width = image.shape
    side = 2 * REACH + 1
    patches = np.empty((len(centres), side, side), np.float32)
    for n in range(len(centres)):
        left, top = int(np.rint(centres[n, 0])) - REACH, int(np.rint(centres[n, 1])) - REACH
        for i in range(side):
            y = min(max(top + i, 0), height - 1)
            for j in range(side):
                patches[n, i, j] = image[y, min(max(left + j, 0), width - 1)]
    return patches


@compiled
def repeated(patches):  # type: ignore[no-untyped-def]
    """Whether each patch (N,) looks the same 2.5 to 4 pixels beside its middle, as fine stripes and grids do."""
    result = np.zeros(len(patches), np.bool_)
    size = (2 * _HALF + 1) ** 2
    first = REACH - _HALF
    for n in range(len(patches)):
        patch = patches[n]
        for dy in range(-4, 5):
            for dx in range(-4, 5):
                if dx * dx + dy * dy < 6 or dx * dx + dy * dy > 16 or result[n]:
                    continue
                a, b, aa, bb, ab = 0.0, 0.0, 0.0, 0.0, 0.0
                for i in range(first, first + 2 * _HALF + 1):
                    for j in range(first, first + 2 * _HALF + 1):
                        here, there = float(patch[i, j]), float(patch[i + dy, j + dx])
                        a, b = a + here, b + there
                        aa, bb, ab = aa + here * here, bb + there * there, ab + here * there
                own, other = aa - a * a / size, bb - b * b / size
                if own <= 0 or (other > 0 and ab - a * b / size > _REPEATED * np.sqrt(own * other)):
                    result[n] = True
    return result


@inlined
def _sample(picture, x, y):  # type: ignore[no-untyped-def]
    column, row = int(np.floor(x)), int(np.floor(y))
    right, below = x - column, y - row
    top = (1 - right) * picture[row, column] + right * picture[row, column + 1]
    bottom = (1 - right) * picture[row + 1, column] + right * picture[row + 1, column + 1]
    return (1 - below) * top + below * bottom


@inlined
def _inverted(matrix, inverse):  # type: ignore[no-untyped-def]
    """Write the inverse of a positive definite matrix (Gauss and Jordan); False where it is not one."""
    count = len(matrix)
    inverse[:] = matrix
    positive = True
    for p in range(count):
        positive = positive and inverse[p, p] > 0
        pivot = 1.0 / inverse[p, p]
        inverse[p, p] = 1.0
        for q in range(count):
            inverse[p, q] *= pivot
        for r in range(count):
            if r != p:
                factor = inverse[r, p]
                inverse[r, p] = 0.0
                for q in range(count):
                    inverse[r, q] -= factor * inverse[p, q]
    return positive


@compiled
def align_patches(image, starts, patches, middles, patch_from_image, max_move):  # type: ignore[no-untyped-def]
    """The kernel of `align`: places (N, 2), correlation (N,), deviation (N,)."""
    height, width = image.shape
    count = 2 * _HALF + 1
    side, size = count + 2, count * count
    places = starts.copy()
    correlation = np.full(len(starts), _NOT_FOUND)
    deviation = np.full(len(starts), np.inf)
    template, columns, found = np.empty((side, side)), np.empty((_COLUMNS, size)), np.empty(size)
    normal, right = np.empty((_COLUMNS, _COLUMNS)), np.empty(_COLUMNS)
    inverse = np.empty((_COLUMNS, _COLUMNS))
    weights = np.empty(size)
    for k in range(size):
        i, j = k // count - _HALF, k % count - _HALF
        weights[k] = np.exp(-(i * i + j * j) / (2 * _SIGMA * _SIGMA))
    weights /= weights.sum()
    for n in range(len(starts)):
        a, b = patch_from_image[n, 0, 0], patch_from_image[n, 0, 1]
        c, d = patch_from_image[n, 1, 0], patch_from_image[n, 1, 1]
        # a fraction of a pixel more for the middle, and one pixel for the interpolation
        if not (_HALF + 1) * max(abs(a) + abs(b), abs(c) + abs(d)) + 0.5 < REACH - 1:
            continue
        for i in range(side):
            for j in range(side):
                dx, dy = j - _HALF - 1, i - _HALF - 1
                template[i, j] = _sample(patches[n], middles[n, 0] + a * dx + b * dy, middles[n, 1] + c * dx + d * dy)
        mean = 0.0
        for k in range(size):
            i, j = k // count, k % count
            gx = 0.5 * (template[i + 1, j + 2] - template[i + 1, j])
            gy = 0.5 * (template[i + 2, j + 1] - template[i, j + 1])
            dx, dy = j - _HALF, i - _HALF
            columns[0, k], columns[1, k], columns[2, k], columns[3, k] = gx, gy, template[i + 1, j + 1], 1.0
            columns[4, k], columns[5, k], columns[6, k], columns[7, k] = gx * dx, gx * dy, gy * dx, gy * dy
            mean += weights[k] * template[i + 1, j + 1]
        columns[2] -= mean
        for p in range(_COLUMNS):
            for q in range(p + 1):
                value = 0.0
                for k in range(size):
                    value += weights[k] * columns[p, k] * columns[q, k]
                normal[p, q], normal[q, p] = value, value
        contrast, trace = normal[2, 2], normal[0, 0] + normal[1, 1]
        if not contrast > _MIN_CONTRAST * _MIN_CONTRAST:
            continue
        if not normal[0, 0] * normal[1, 1] - normal[0, 1] ** 2 > _MIN_CORNER * trace * trace:
            continue
        for p in range(4, _COLUMNS):
            normal[p, p] += _RIDGE * (normal[p, p] + trace)
        if not _inverted(normal, inverse):
            continue
        x, y, gain = starts[n, 0], starts[n, 1], 0.0
        converged = False
        for _ in range(_MAX_ITERATIONS):
            if not (_HALF <= x < width - _HALF - 1 and _HALF <= y < height - _HALF - 1):
                break
            left, top = int(np.floor(x)), int(np.floor(y))
            fx, fy = x - left, y - top
            left, top = left - _HALF, top - _HALF
            w00, w01, w10, w11 = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
            for i in range(count):
                for j in range(count):
                    r, s = top + i, left + j
                    upper = w00 * image[r, s] + w01 * image[r, s + 1]
                    found[i * count + j] = upper + w10 * image[r + 1, s] + w11 * image[r + 1, s + 1]
            for p in range(_COLUMNS):
                value = 0.0
                for k in range(size):
                    value += weights[k] * columns[p, k] * found[k]
                right[p] = value
            step_x, step_y, gain = 0.0, 0.0, 0.0
            for q in range(_COLUMNS):
                step_x -= inverse[0, q] * right[q]
                step_y -= inverse[1, q] * right[q]
                gain += inverse[2, q] * right[q]
            if not gain > _MIN_GAIN:
                break
            step_x, step_y = step_x / gain, step_y / gain
            longest = max(abs(step_x), abs(step_y))
            if longest > 1.0:
                step_x, step_y = step_x / longest, step_y / longest
            x, y = x + step_x, y + step_y
            if not (x - starts[n, 0]) ** 2 + (y - starts[n, 1]) ** 2 <= max_move * max_move:
                break
            if longest < _CONVERGED:
                converged = True
                break
        if not converged:
            continue
        both, own = 0.0, 0.0
        for k in range(size):
            both += weights[k] * columns[2, k] * (found[k] - right[3])
            own += weights[k] * (found[k] - right[3]) ** 2
        if not own > 0:
            continue
        places[n, 0], places[n, 1] = x, y
        correlation[n] = both / np.sqrt(contrast * own)
        noise = max(own - both * both / contrast, 0.0) / (gain * gain)
        deviation[n] = np.sqrt(noise * (inverse[0, 0] + inverse[1, 1]) / (0.5 * size))
    return places, correlation, deviation


def warps_between(cam_from_anchor: Float64, xyz_cam: Float64, depth: Float64, focal: Float64) -> tuple[Float64, Mask]:
    """How a small patch that faces the anchor's camera looks in another camera.

    Args:
        cam_from_anchor: (N, 3, 3) rotations.
        xyz_cam: (N, 3) the points in the other camera.
        depth: (N,) of the points in the anchor's camera.
        focal: (2,) pixels, fx and fy of both.

    Returns:
        (N, 2, 2) anchor pixels from pixels of the other picture, around the point; and whether it can be seen (N,).
    """
    z = xyz_cam[:, 2]
    good = (depth > 1e-9) & (z > 1e-9)
    z, depth = np.where(good, z, 1.0), np.where(good, depth, 1.0)
    slope = xyz_cam[:, :2] / z[:, None]
    R = cam_from_anchor
    forward = (depth / z)[:, None, None] * (R[:, :2, :2] - slope[:, :, None] * R[:, 2:3, :2])
    forward = np.asarray(forward * (focal[:, None] / focal[None, :]), np.float64)
    good &= np.abs(np.linalg.det(forward)) > 1e-3
    forward[~good] = np.eye(2)
    return np.asarray(np.linalg.inv(forward), np.float64), good


def patch_middles(pixels: Float64) -> Float64:
    """Where points (N, 2) lie within the patches that are cut around them."""
    return np.asarray(REACH + pixels - np.rint(pixels))
