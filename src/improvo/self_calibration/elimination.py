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
        by_value: (M, 2, 6) by the lens.
        by_point: (M, 2, 3) by the point.
        residuals: (M, 2).
        weights: (M,).
        views: V.
        damping: of the points' blocks, relative to their diagonals.

    Returns:
        Matrix (6 V + 6, 6 V + 6) and right side of the views and the lens, the inverse blocks of the points (P, 3, 3),
        and the coupling of each point with the lens (P, 6, 3).
    """
    size = 6 * views
    points = len(first) - 1
    reduced = np.zeros((size + 6, size + 6))
    right = np.zeros(size + 6)
    inverses = np.zeros((points, 3, 3))
    couplings = np.zeros((points, 6, 3))
    longest = 1
    for j in range(points):
        longest = max(longest, first[j + 1] - first[j])
    own = np.zeros((longest, 6, 3))  # coupling of the point with each of its views
    scaled = np.zeros((longest + 1, 6, 3))  # the same, times the inverse block
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
            for a in range(6):
                for b in range(6):
                    pose_pose = 0.0
                    pose_lens = 0.0
                    lens_lens = 0.0
                    for i in range(2):
                        pose_pose += by_pose[m, i, a] * by_pose[m, i, b]
                        pose_lens += by_pose[m, i, a] * by_value[m, i, b]
                        lens_lens += by_value[m, i, a] * by_value[m, i, b]
                    reduced[at + a, at + b] += w * pose_pose
                    reduced[at + a, size + b] += w * pose_lens
                    reduced[size + a, size + b] += w * lens_lens
                for b in range(3):
                    pose_point = 0.0
                    lens_point = 0.0
                    for i in range(2):
                        pose_point += by_pose[m, i, a] * by_point[m, i, b]
                        lens_point += by_value[m, i, a] * by_point[m, i, b]
                    own[m - begin, a, b] = w * pose_point
                    lens[a, b] += w * lens_point
                for i in range(2):
                    right[at + a] -= w * by_pose[m, i, a] * residuals[m, i]
                    right[size + a] -= w * by_value[m, i, a] * residuals[m, i]
            for a in range(3):
                for i in range(2):
                    pull[a] += w * by_point[m, i, a] * residuals[m, i]
                    for b in range(3):
                        block[a, b] += w * by_point[m, i, a] * by_point[m, i, b]
        for a in range(3):
            block[a, a] += damping * block[a, a] + 1e-12
        inverse = inverses[j]
        _invert(block, inverse)
        for slot in range(end - begin + 1):
            from_point = own[slot] if slot < end - begin else lens
            at = 6 * view[begin + slot] if slot < end - begin else size
            for a in range(6):
                for b in range(3):
                    total = 0.0
                    for i in range(3):
                        total += from_point[a, i] * inverse[i, b]
                    scaled[slot, a, b] = total
                right[at + a] += (
                    scaled[slot, a, 0] * pull[0] + scaled[slot, a, 1] * pull[1] + scaled[slot, a, 2] * pull[2]
                )
        for slot in range(end - begin + 1):
            row = 6 * view[begin + slot] if slot < end - begin else size
            for other in range(end - begin + 1):
                if slot == end - begin and other < slot:
                    continue
                column = 6 * view[begin + other] if other < end - begin else size
                right_part = own[other] if other < end - begin else lens
                for a in range(6):
                    s0, s1, s2 = scaled[slot, a, 0], scaled[slot, a, 1], scaled[slot, a, 2]
                    for b in range(6):
                        reduced[row + a, column + b] -= (
                            s0 * right_part[b, 0] + s1 * right_part[b, 1] + s2 * right_part[b, 2]
                        )
    for a in range(size):
        for b in range(6):
            reduced[size + b, a] = reduced[a, size + b]
    return reduced, right, inverses, couplings


@compiled
def back_substitute(view, first, by_pose, by_value, by_point, residuals, weights, inverses, couplings, step):
    """The step (P, 3) of every point, from that of views and lens (6 V + 6,); the rest as in `eliminate`."""
    points = len(first) - 1
    size = len(step) - 6
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
            for a in range(6):
                pull[b] += couplings[j, a, b] * step[size + a]
        for a in range(3):
            for b in range(3):
                moved[j, a] -= inverses[j, a, b] * pull[b]
    return moved


@compiled
def _invert(block, inverse):
    """The inverse of a symmetric 3x3 matrix."""
    a, b, c, d, e, f = block[0, 0], block[0, 1], block[0, 2], block[1, 1], block[1, 2], block[2, 2]
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    over = 1.0 / (a * c00 + b * c01 + c * c02)
    inverse[0, 0], inverse[0, 1], inverse[0, 2] = c00 * over, c01 * over, c02 * over
    inverse[1, 0], inverse[1, 1], inverse[1, 2] = c01 * over, (a * f - c * c) * over, (b * c - a * e) * over
    inverse[2, 0], inverse[2, 1], inverse[2, 2] = c02 * over, (b * c - a * e) * over, (a * d - b * b) * over
