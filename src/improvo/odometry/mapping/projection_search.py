"""Search by projection: each projected map point takes the most similar free keypoint near its projection."""

from __future__ import annotations

import numpy as np

from improvo.compiled import compiled
from improvo.types import Float32, Float64, Int64


def match_by_projection(
    projections: Float64,
    point_descriptors: Float32,
    keypoints: Float64,
    keypoint_descriptors: Float32,
    radius: float,
    max_distance: float,
) -> Int64:
    """Index pairs (K, 2) of projected points and keypoints, each used once.

    Args:
        projections: (P, 2) pixels, inside the image.
        point_descriptors: (P, D) unit vectors.
        keypoints: (N, 2) pixels.
        keypoint_descriptors: (N, D) unit vectors.
        radius: pixels between a projection and its keypoint, at most.
        max_distance: between the descriptors, at most.
    """
    if len(projections) == 0 or len(keypoints) == 0:
        return np.zeros((0, 2), np.int64)
    order, cell_starts, columns, rows, origin = _grid(keypoints, radius)
    keypoint_of_point, similarity = best_in_radius(
        projections,
        point_descriptors,
        keypoints,
        keypoint_descriptors,
        order,
        cell_starts,
        columns,
        rows,
        origin,
        radius,
    )
    good = (keypoint_of_point >= 0) & (2.0 - 2.0 * similarity <= max_distance**2)
    points = np.flatnonzero(good)
    best_first = points[np.argsort(-similarity[points], kind="stable")]
    _, first = np.unique(keypoint_of_point[best_first], return_index=True)
    winners = best_first[np.sort(first)]
    return np.stack([winners, keypoint_of_point[winners]], axis=1)


def _grid(keypoints: Float64, cell: float) -> tuple[Int64, Int64, int, int, Float64]:
    """Keypoints sorted by square cells: order (N,), start of each cell, number of columns and rows, origin (2,)."""
    origin = keypoints.min(axis=0)
    cells = ((keypoints - origin) // cell).astype(np.int64)
    columns, rows = (int(size) + 1 for size in cells.max(axis=0))
    flat = cells[:, 1] * columns + cells[:, 0]
    order = np.argsort(flat, kind="stable")
    return order, np.searchsorted(flat[order], np.arange(columns * rows + 1)), columns, rows, origin


@compiled
def best_in_radius(  # type: ignore[no-untyped-def]
    projections,
    point_descriptors,
    keypoints,
    keypoint_descriptors,
    order,
    cell_starts,
    columns,
    rows,
    origin,
    radius,
):
    """For each projection the most similar keypoint within the radius: its index (P,) or -1, and the similarity."""
    best = np.full(len(projections), -1, np.int64)
    best_similarity = np.full(len(projections), -2.0)
    for p in range(len(projections)):
        x, y = projections[p, 0], projections[p, 1]
        column = int(np.floor((x - origin[0]) / radius))
        row = int(np.floor((y - origin[1]) / radius))
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(max(column - 1, 0), min(column + 2, columns)):
                for k in range(cell_starts[r * columns + c], cell_starts[r * columns + c + 1]):
                    i = order[k]
                    dx, dy = keypoints[i, 0] - x, keypoints[i, 1] - y
                    if dx * dx + dy * dy > radius * radius:
                        continue
                    similarity = 0.0
                    for d in range(point_descriptors.shape[1]):
                        similarity += point_descriptors[p, d] * keypoint_descriptors[i, d]
                    if similarity > best_similarity[p]:
                        best_similarity[p] = similarity
                        best[p] = i
    return best, best_similarity
