"""Mutual nearest neighbours (paper, "Point Tracks").

Every descriptor becomes a unit vector, so one matrix product gives all distances. Bits b of a binary descriptor become
(2b - 1) / sqrt(number of bits), for which the squared distance is 4 x (share of differing bits).
"""

from __future__ import annotations

import numpy as np

from improvo.compiled import compiled
from improvo.errors import InputError
from improvo.types import Features, Float32, Int64

RANDOM_DISTANCE = float(np.sqrt(2.0))  # expected distance of two unrelated unit descriptors


def unit_descriptors(features: Features) -> Float32:
    """The descriptors as unit float32 vectors (N, D)."""
    if not features.binary:
        return np.asarray(features.descriptors, np.float32)
    bits = np.unpackbits(np.asarray(features.descriptors, np.uint8), axis=1)
    scale = np.float32(1.0 / np.sqrt(max(bits.shape[1], 1)))
    return (bits.astype(np.float32) * 2.0 - 1.0) * scale


def distance_threshold(features: Features, max_distance: float) -> float:
    """The paper's threshold tau on unit descriptors, or its equivalent share of differing bits as a distance.

    tau = 0.7 is 0.7 / 1.41 of the distance between unrelated float descriptors. For binary descriptors the same share
    of the Hamming distance between unrelated ones is used: 63 of 256 bits.
    """
    if not features.binary:
        return max_distance
    return float(np.sqrt(2.0 * max_distance / RANDOM_DISTANCE))


def mutual_nearest_neighbours(a: Features, b: Features, max_distance: float | None = None) -> Int64:
    """Index pairs (K, 2) of mutually nearest descriptors, sorted by the index in `a`.

    Args:
        a, b: features of two images, by the same frontend.
        max_distance: tau, drop pairs farther apart (scaled for binary descriptors); None keeps all.

    Raises:
        InputError: descriptors of two kinds, which no distance compares.
    """
    if a.binary != b.binary or a.descriptors.shape[1] != b.descriptors.shape[1]:
        kinds = " and ".join(f"{each.descriptors.shape[1]} {each.descriptors.dtype}" for each in (a, b))
        raise InputError(
            f"features: descriptors of {kinds} numbers cannot be matched; use one frontend for both images"
        )
    threshold = None if max_distance is None else distance_threshold(a, max_distance)
    return match_units(unit_descriptors(a), unit_descriptors(b), threshold)


def match_units(a: Float32, b: Float32, max_distance: float | None = None) -> Int64:
    """As `mutual_nearest_neighbours`, on unit vectors (N, D) and (M, D), without scaling the threshold."""
    if len(a) == 0 or len(b) == 0:
        return np.zeros((0, 2), np.int64)
    nearest_in_b, nearest_in_a, best = nearest_both_ways(a @ b.T)
    rows = np.flatnonzero(nearest_in_a[nearest_in_b] == np.arange(len(a)))
    if max_distance is not None:
        # ||x - y||^2 = 2 - 2 x.y for unit vectors
        rows = rows[2.0 - 2.0 * best[rows] <= max_distance**2]
    return np.stack([rows, nearest_in_b[rows]], axis=1)


def without_flow_outliers(matches: Int64, keypoints_a: Float32, keypoints_b: Float32, limit: float) -> Int64:
    """The pairs (K, 2) whose motion is at most `limit` pixels from the median motion of all.

    Points move little between two frames of a video. A pair that moves very differently from the others is a wrong
    match. The median follows a camera that turns fast.

    Args:
        matches: (K, 2) rows of `keypoints_a` and of `keypoints_b`.
        keypoints_a: (N, 2) pixels.
        keypoints_b: (M, 2) pixels.
        limit: pixels.
    """
    if len(matches) == 0:
        return matches
    motion = keypoints_b[matches[:, 1]].astype(np.float64) - keypoints_a[matches[:, 0]]
    return matches[np.linalg.norm(motion - np.median(motion, axis=0), axis=1) <= limit]


@compiled
def nearest_both_ways(similarity):  # type: ignore[no-untyped-def]
    """Largest entry of each row and of each column in one pass (the first of equals), and the rows' largest values.

    NumPy's argmax over columns alone costs as much as the product of the matrices.
    """
    rows, columns = similarity.shape
    best_column = np.zeros(rows, np.int64)
    best_row = np.zeros(columns, np.int64)
    row_best = np.full(rows, np.float32(-np.inf))
    column_best = np.full(columns, np.float32(-np.inf))
    for i in range(rows):
        for j in range(columns):
            value = similarity[i, j]
            if value > row_best[i]:
                row_best[i] = value
                best_column[i] = j
            if value > column_best[j]:
                column_best[j] = value
                best_row[j] = i
    return best_column, best_row, row_best
