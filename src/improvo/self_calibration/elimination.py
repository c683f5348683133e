"""The normal equations of a bundle adjustment with a shared lens, the points eliminated; and the points' own step."""
# mypy: disable-error-code="no-untyped-def,no-untyped-call"

from __future__ import annotations

import numpy as np

from improvo.compiled import compiled


@compiled
def eliminate(view, first, by_pose, by_value, by_point, residuals, weights, views, damping):
    """The reduced system of views and lens.

    Args:
        view: (M,) of each observation; observations are sorted by point.
        first: (P + 1,) where those of each point begin.
        by_pose: (M, 2, 6) derivatives of the residuals by the view's pose.
        by_value: (M, 2, L) by the numbers of the lens.
        by_point: (M, 2, 3) by the point.
        residuals: (M, 2).
        weights: (M,).
        views: V.
        damping: of the points' blocks, relative to their diagonals.

    Returns:
        Matrix (6 V + L, 6 V + L) and right side of the views and the lens, the inverse blocks of the points (P, 3, 3),
        and the coupling of each point with the lens (P, L, 3).
    """
    size = 6 * views
    shared = by_value.shape[2]
    points = len(first) - 1
    reduced = np.zeros((size + shared, size + shared))
    right = np.zeros(size + shared)
    inverses = np.zeros((points, 3, 3))
    couplings = np.zeros((points, shared, 3))
    longest = 1
    for j in range(points):
        longest = max(longest, first[j + 1] - first[j])
    own = np.zeros((longest, 6, 3))  # coupling of the point with each of its views
    scaled = np.zeros((longest, 6, 3))  # the same, times the inverse block
    scaled_lens = np.zeros((shared, 3))
    block = np.zeros((3, 3))
    pull = np.zeros(3)
    for j in range(points):
        begin, end = first[j], first[j + 1]
        block[:] = 0.0
        pull[:] = 0.0
        lens = couplings[j]
        for m in range(begin, end):
            w = weights[m]
            at = 6 * view[m]
            for i in range(2):
                for a in range(6):
                    weighted = w * by_pose[m, i, a]
                    right[at + a] -= weighted * residuals[m, i]
                    for b in range(6):
                        reduced[at + a, at + b] += weighted * by_pose[m, i, b]
                    for b in range(shared):
                        reduced[at + a, size + b] += weighted * by_value[m, i, b]
                for a in range(shared):
                    weighted = w * by_value[m, i, a]
                    right[size + a] -= weighted * residuals[m, i]
                    for b in range(shared):
                        reduced[size + a, size + b] += weighted * by_value[m, i, b]
                    for b in range(3):
                        lens[a, b] += weighted * by_point[m, i, b]
            for a in range(6):
                for b in range(3):
                    own[m - begin, a, b] = w * (
                        by_pose[m, 0, a] * by_point[m, 0, b] + by_pose[m, 1, a] * by_point[m, 1, b]
                    )
            for a in range(3):
                for i in range(2):
                    pull[a] += w * by_point[m, i, a] * residuals[m, i]
                    for b in range(3):
                        block[a, b] += w * by_point[m, i, a] * by_point[m, i, b]
        for a in range(3):
            block[a, a] += damping * block[a, a] + 1e-12
        inverse = inverses[j]
        _invert(block, inverse)
        for slot in range(end - begin):
            _times(own[slot], inverse, scaled[slot], right, 6 * view[begin + slot], pull)
        _times(lens, inverse, scaled_lens, right, size, pull)
        for slot in range(end - begin):
            row = 6 * view[begin + slot]
            for other in range(end - begin):
                _take(reduced, row, 6 * view[begin + other], scaled[slot], own[other])
            _take(reduced, row, size, scaled[slot], lens)
        _take(reduced, size, size, scaled_lens, lens)
    for a in range(size):
        for b in range(shared):
            reduced[size + b, a] = reduced[a, size + b]
    return reduced, right, inverses, couplings


@compiled
def back_substitute(view, first, by_pose, by_value, by_point, residuals, weights, inverses, couplings, step):
    """The step (P, 3) of every point, from that of views and lens (6 V + L,); the rest as in `eliminate`."""
    points = len(first) - 1
    shared = couplings.shape[1]
    size = len(step) - shared
    moved = np.zeros((points, 3))
    pull = np.zeros(3)
    for j in range(points):
        pull[:] = 0.0
        for m in range(first[j], first[j + 1]):
            at = 6 * view[m]
            for i in range(2):
                change = residuals[m, i]
                for a in range(6):
                    change += by_pose[m, i, a] * step[at + a]
                for b in range(3):
                    pull[b] += weights[m] * by_point[m, i, b] * change
        for b in range(3):
            for a in range(shared):
                pull[b] += couplings[j, a, b] * step[size + a]
        for a in range(3):
            for b in range(3):
                moved[j, a] -= inverses[j, a, b] * pull[b]
    return moved


@compiled
def _times(coupling, inverse, scaled, right, at, pull):
    """A coupling times the inverse block of its point, and its part of the right side."""
    for a in range(len(coupling)):
        for b in range(3):
            scaled[a, b] = (
                coupling[a, 0] * inverse[0, b] + coupling[a, 1] * inverse[1, b] + coupling[a, 2] * inverse[2, b]
            )
        right[at + a] += scaled[a, 0] * pull[0] + scaled[a, 1] * pull[1] + scaled[a, 2] * pull[2]


@compiled
def _take(reduced, row, column, scaled, coupling):
    """Take the part of the reduced system that goes through a point."""
    for a in range(len(scaled)):
        s0, s1, s2 = scaled[a, 0], scaled[a, 1], scaled[a, 2]
        for b in range(len(coupling)):
            reduced[row + a, column + b] -= s0 * coupling[b, 0] + s1 * coupling[b, 1] + s2 * coupling[b, 2]


@compiled
def _invert(block, inverse):
    """The inverse of a symmetric 3x3 matrix."""
    a, b, c, d, e, f = block[0, 0], block[0, 1], block[0, 2], block[1, 1], block[1, 2], block[2, 2]
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    over = 1.0 / (a * c00 + b * c01 + c * c02)
    inverse[0, 0], inverse[0, 1], inverse[0, 2] = c00 * over, c01 * over, c02 * over
    inverse[1, 0], inverse[1, 1], inverse[1, 2] = c01 * over, (a * f - c * c) * over, (b * c - a * e) * over
    inverse[2, 0], inverse[2, 1], inverse[2, 2] = c02 * over, (b * c - a * e) * over, (a * d - b * b) * over
