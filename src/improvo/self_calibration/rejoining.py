"""Points found again in all views of a scene: the long tracks that tell the lens, which an odometry does not need.

The odometry links what it saw a moment ago. Where the camera comes back, the same spot is another point, and under a
lens that is not right yet observations are lost. So every point is looked for in every view of its world, around where
it should be.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from improvo.geometry.se3 import transform
from improvo.self_calibration.adjustment import Scene
from improvo.types import Float32, Float64, Int64, Mask


@dataclass(frozen=True)
class SceneView:
    """All keypoints of a selected view."""

    pixels: Float64  # (N, 2) raw
    descriptors: Float32  # (N, D) unit vectors
    max_distance: float  # of descriptors of the same spot
    world: int  # of the odometry; points of another one lie elsewhere


def rejoined(scene: Scene, views: list[SceneView], radius: float) -> Scene:
    """The scene with further observations, and with points made one that are seen at the same keypoints.

    Args:
        scene: adjusted.
        views: what each of its views saw.
        radius: pixels between a projection and a keypoint that may be its own.
    """
    keypoint, descriptors = _own_keypoints(scene, views)
    world = np.array([view.world for view in views])[scene.view[_starts(scene)]]
    merged = np.arange(len(scene.xyz))
    seen = np.zeros((len(scene.xyz), len(views)), bool)
    seen[scene.point, scene.view] = True
    new_view, new_point, new_pixels = [scene.view], [scene.point], [scene.pixels]
    for number, view in enumerate(views):
        owner = np.full(len(view.pixels), -1)
        here = np.flatnonzero(scene.view == number)
        owner[keypoint[here]] = scene.point[here]
        absent = world == view.world
        absent[scene.point[here]] = False
        points = np.flatnonzero(absent)
        rows, found = _found_in(scene, number, view, points, descriptors, radius)
        free = owner[found] < 0
        new_view.append(np.full(int(free.sum()), number))
        new_point.append(rows[free])
        new_pixels.append(view.pixels[found[free]])
        for a, b in zip(rows[~free].tolist(), owner[found[~free]].tolist(), strict=True):
            _unite(merged, seen, a, b)
    view_of = np.concatenate(new_view)
    point = merged[np.concatenate(new_point)]
    pixels = np.concatenate(new_pixels)
    _, kept = np.unique(point * len(views) + view_of, return_index=True)  # sorted by point, then view
    joined = replace(scene, view=view_of[kept], point=point[kept], pixels=pixels[kept])
    return joined.without(np.zeros(len(kept), bool))


def _found_in(
    scene: Scene, number: int, view: SceneView, points: Int64, descriptors: Float32, radius: float
) -> tuple[Int64, Int64]:
    """Points and keypoints of a view that are each other's best."""
    points_cam = transform(scene.cam_from_world[number], scene.xyz[points])
    expected = scene.lens.project(points_cam)[0]
    size = scene.lens.width, scene.lens.height
    inside = (expected > -radius).all(axis=1) & (expected < np.add(size, radius)).all(axis=1)
    points, expected = points[inside], expected[inside]
    if len(points) == 0 or len(view.pixels) == 0:
        return points[:0], points[:0]
    alike = descriptors[points] @ view.descriptors.T
    off = ((expected[:, None] - view.pixels[None]) ** 2).sum(axis=-1)
    alike[(off > radius**2) | (2.0 - 2.0 * alike > view.max_distance**2)] = -np.inf
    best = alike.argmax(axis=1)
    mutual = alike.argmax(axis=0)[best] == np.arange(len(points))
    rows = np.flatnonzero(mutual & np.isfinite(alike[np.arange(len(points)), best]))
    return points[rows], best[rows]


def _own_keypoints(scene: Scene, views: list[SceneView]) -> tuple[Int64, Float32]:
    """The keypoint (M,) that each observation is, and the descriptor (P, D) of each point, from its middle view."""
    keypoint = np.zeros(len(scene.view), np.int64)
    for number, view in enumerate(views):
        here = np.flatnonzero(scene.view == number)
        row_of = {pixel: row for row, pixel in enumerate(map(tuple, view.pixels.tolist()))}
        keypoint[here] = [row_of[pixel] for pixel in map(tuple, scene.pixels[here].tolist())]
    starts = np.append(_starts(scene), len(scene.view))
    middle = (starts[:-1] + starts[1:]) // 2
    width = views[0].descriptors.shape[1]
    descriptors = np.zeros((len(scene.xyz), width), np.float32)
    for number, view in enumerate(views):
        here = np.flatnonzero(scene.view[middle] == number)
        descriptors[here] = view.descriptors[keypoint[middle[here]]]
    return keypoint, descriptors


def _starts(scene: Scene) -> Int64:
    """(P,) the first observation of each point."""
    return np.searchsorted(scene.point, np.arange(len(scene.xyz)))


def _unite(merged: Int64, seen: Mask, a: int, b: int) -> None:
    """Make points a and b one, and all that were made one with them, unless a view sees both: then they are two."""
    one, other = sorted((int(merged[a]), int(merged[b])))
    if one != other and not (seen[one] & seen[other]).any():
        merged[merged == other] = one
        seen[one] |= seen[other]
