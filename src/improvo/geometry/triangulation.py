"""Points of many tracks at once, with the poses held: for new points of the odometry and for the labels.

For each track: a few two-view points and the point nearest to all rays are scored by the robust cost of all views, and
the best is refined by re-weighted Gauss-Newton. Two-view starts because a track with a wrong link has views that no
single point explains: the point nearest to all of its rays is near to none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from improvo.geometry.settings import TriangulationSettings
from improvo.geometry.triangulation_kernels import triangulate_all
from improvo.types import Float64, Int64


@dataclass(frozen=True)
class Triangulation:
    """One row per track, and one error per observation."""

    points: Float64  # (T, 3) world; NaN with fewer than two views from cameras that have a pose
    errors: Float64  # (O,) pixels; NaN where the camera has no pose or the track no point
    parallax_deg: Float64  # (T,) largest angle between two rays from the point to cameras that saw it
    in_front: NDArray[np.bool_]  # (T,) the point has positive depth in each camera that saw it
    ok: NDArray[np.bool_]  # (T,) found, in front, and with enough parallax


def triangulate_tracks(
    keypoints: Float64,
    camera_index: Int64,
    track_offsets: Int64,
    cam_from_world: Float64,
    K: Float64,
    settings: TriangulationSettings | None = None,
) -> Triangulation:
    """Robust many-view triangulation.

    Args:
        keypoints: (O, 2) pixels, sorted by track.
        camera_index: (O,) row of `cam_from_world` of each observation.
        track_offsets: (T + 1,) the observations of track t are rows track_offsets[t]:track_offsets[t + 1].
        cam_from_world: (N, 4, 4); a row with NaN is a camera without a pose: its observations are left out.
        K: (3, 3).

    Raises:
        ValueError: offsets or indices that do not fit the arrays.
    """
    settings = settings or TriangulationSettings()
    keypoints = np.ascontiguousarray(keypoints, np.float64).reshape(-1, 2)
    camera_index = np.ascontiguousarray(camera_index, np.int64)
    offsets = np.ascontiguousarray(track_offsets, np.int64)
    cam_from_world = np.ascontiguousarray(cam_from_world, np.float64).reshape(-1, 4, 4)
    if len(camera_index) != len(keypoints):
        raise ValueError(f"camera_index has {len(camera_index)} rows, keypoints {len(keypoints)}")
    if len(offsets) < 1 or offsets[0] != 0 or offsets[-1] != len(keypoints) or (np.diff(offsets) < 0).any():
        raise ValueError("track_offsets must rise from 0 to the number of observations")
    if len(camera_index) and not 0 <= camera_index.min() <= camera_index.max() < len(cam_from_world):
        raise ValueError(f"camera_index refers to rows outside 0..{len(cam_from_world) - 1}")
    intrinsics = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    found, errors, parallax_deg, in_front = triangulate_all(
        keypoints,
        camera_index,
        offsets,
        cam_from_world,
        intrinsics,
        settings.loss == "geman_mcclure",
        float(settings.loss_width),
        settings.max_iterations,
    )
    ok = in_front & (parallax_deg >= settings.min_parallax_deg)
    return Triangulation(found, errors, parallax_deg, in_front, ok)
