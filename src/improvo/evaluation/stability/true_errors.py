"""Whether tracks stayed on the surface point they began on, from the true poses and depth of a recording."""

from __future__ import annotations

import numpy as np

from improvo.geometry.camera import Camera
from improvo.geometry.se3 import inverse, transform
from improvo.types import Float32, Float64, Int64

_ANCHORS = 4  # observations of a track that are taken as the point it should have stayed on


def true_track_errors(
    frame: Int64,
    track: Int64,
    keypoints: Float32,
    wanted: Int64,
    camera: Camera,
    world_from_cam: Float64,
    depth: dict[int, Float32],
) -> Float64:
    """The largest distance of a track's observations from where one static surface point is truly seen.

    The point is that of one of the track's own observations, the one that explains the others best; at a jump of depth
    both surfaces are tried. A track that kept to a static point has a small error, however wrong the odometry was.

    Args:
        frame, track, keypoints: (M,), (M,), (M, 2) rows of observations.
        wanted: (T,) tracks to judge.
        camera: of the images.
        world_from_cam: (F, 4, 4) true poses by frame.
        depth: frame -> (H, W) metres, NaN where missing; of some frames.

    Returns:
        (T,) pixels; NaN for a track without an observation in a frame with depth.
    """
    order = np.argsort(track, kind="stable")
    start, end = (np.searchsorted(track[order], wanted, side=side) for side in ("left", "right"))
    cam_from_world = inverse(world_from_cam)
    errors = np.full(len(wanted), np.nan)
    for number, (first, last) in enumerate(zip(start, end, strict=True)):
        rows = order[first:last]
        anchors = [row for row in rows if int(frame[row]) in depth]
        anchors = (
            [anchors[i] for i in np.unique(np.linspace(0, len(anchors) - 1, _ANCHORS).astype(int))] if anchors else []
        )
        points = [point for row in anchors for point in _points(row, frame, keypoints, camera, world_from_cam, depth)]
        if not points:
            continue
        seen_from = transform(cam_from_world[frame[rows]], np.asarray(points)[None])  # (observations, points, 3)
        away = np.linalg.norm(camera.project(seen_from) - keypoints[rows][:, None], axis=2)
        errors[number] = away.max(axis=0).min()
    return errors


def _points(
    row: int,
    frame: Int64,
    keypoints: Float32,
    camera: Camera,
    world_from_cam: Float64,
    depth: dict[int, Float32],
) -> list[Float64]:
    """The nearest and the farthest surface around an observation, in the world."""
    image = depth[int(frame[row])]
    place = keypoints[row].astype(np.float64)
    x, y = (int(value) for value in np.rint(place))
    patch = image[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2]
    if not np.isfinite(patch).any():
        return []
    pose = world_from_cam[frame[row]]
    return [transform(pose, camera.unproject(place[None], float(z)))[0] for z in (np.nanmin(patch), np.nanmax(patch))]
