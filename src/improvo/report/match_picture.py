"""How two frontends match one image pair (paper, Figure "Qualitative ScanNet Comparison"): three panels each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from improvo.evaluation.pose.estimators import with_robust_solver
from improvo.frontend import Frontend
from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.geometry.depth_sampling import depth_at
from improvo.report.canvas import Canvas, captioned, stacked
from improvo.report.palettes import PALETTES, Palette
from improvo.tracking.matching import mutual_nearest_neighbours
from improvo.types import Features, Float32, Float64, Int64, Mask, UInt8

_GOOD_ERROR = 3.0  # pixels, paper
_EPIPOLAR_ERROR = 2.0  # pixels, of the five-point estimate where there is no depth


@dataclass(frozen=True)
class Carried:
    """Points of A in B under the estimated pose."""

    matches: Int64  # (K, 2) those that can be judged
    predicted: Float64  # (K, 2) pixels in B
    error: Float64  # (K,) pixels
    inliers: int  # of the pose estimate; 0 where there is none
    how: str  # for the caption
    behind: int = 0  # matches more, whose point of A is behind B


def paint_matches(
    frontend: Frontend,
    image_a: UInt8,
    image_b: UInt8,
    depth_a: Float32 | None,
    camera: Camera,
    palette: Palette = PALETTES["paper"],
    width: int = 640,
    masks: tuple[Mask | None, Mask | None] = (None, None),
) -> UInt8:
    """Three panels: detections in A; detections in B with the flow of the matches; A's points carried into B.

    With depth, the pose comes from 3D-to-2D matches as in the paper. Without, from the five-point method, and a point
    is carried to the nearest place of its epipolar line.
    """
    a, b = (
        frontend(image) if mask is None else frontend(image, mask)
        for image, mask in zip((image_a, image_b), masks, strict=True)
    )
    matches = mutual_nearest_neighbours(a, b)
    panel_a = _panel(image_a, width)
    panel_a.dots(a.keypoints, _fill(palette.keypoint, len(a)), 1.4)
    panel_b = _panel(image_b, width)
    panel_b.segments(a.keypoints[matches[:, 0]], b.keypoints[matches[:, 1]], _fill(palette.flow, len(matches)))
    panel_b.dots(b.keypoints, _fill(palette.keypoint, len(b)), 1.4)
    carried = carry(a, b, matches, depth_a, camera)
    good = carried.error < _GOOD_ERROR
    panel_c = _panel(image_b, width)
    observed = b.keypoints[carried.matches[:, 1]].astype(np.float64)
    panel_c.segments(carried.predicted[~good], observed[~good], _fill(palette.unstable, int((~good).sum())))
    panel_c.dots(carried.predicted[~good], _fill(palette.unstable, int((~good).sum())), 1.6)
    panel_c.dots(carried.predicted[good], _fill(palette.stable, int(good.sum())), 1.8)
    return stacked(
        [
            captioned(panel_a.rgb, f"{Path(frontend.name).name}: {len(a)} points in A"),
            captioned(panel_b.rgb, f"{len(b)} points in B, {len(matches)} matches"),
            captioned(
                panel_c.rgb,
                f"{int(good.sum())} of {len(good) + carried.behind} within {_GOOD_ERROR:g} px; {carried.how}",
            ),
        ],
        columns=3,
    )


def carry(a: Features, b: Features, matches: Int64, depth_a: Float32 | None, camera: Camera) -> Carried:
    """The relative pose from the matches, and where it puts the matched points of A in B."""
    if depth_a is None:
        return _carry_along_epipolar_lines(a, b, matches, camera)
    depth = depth_at(a.keypoints[matches[:, 0]], depth_a)
    known = matches[np.isfinite(depth)]
    points = camera.unproject(a.keypoints[known[:, 0]].astype(np.float64), depth[np.isfinite(depth)])
    pixels = b.keypoints[known[:, 1]].astype(np.float64)
    estimate = with_robust_solver(points, pixels, camera, seed=0)
    if estimate is None:
        return _nothing("no pose was found")
    points_b = se3.transform(estimate.cam_from_world, points)
    front = points_b[:, 2] > 1e-6
    predicted = camera.project(points_b[front])
    inliers = int(estimate.inliers.sum())
    error = np.linalg.norm(predicted - pixels[front], axis=1)
    return Carried(known[front], predicted, error, inliers, f"pose by PnP, {inliers} inliers", int((~front).sum()))


def _carry_along_epipolar_lines(a: Features, b: Features, matches: Int64, camera: Camera) -> Carried:
    from improvo.geometry.epipolar import epipolar_lines
    from improvo.geometry.ransac import Ransac, relative_pose

    pixels_a = a.keypoints[matches[:, 0]].astype(np.float64)
    pixels_b = b.keypoints[matches[:, 1]].astype(np.float64)
    if len(matches) < 8:
        return _nothing("too few matches for a pose")
    found = relative_pose(pixels_a, pixels_b, camera, Ransac(_EPIPOLAR_ERROR, seed=0))
    lines = epipolar_lines(found.pose, camera, pixels_a)
    norm = np.linalg.norm(lines[:, :2], axis=1)
    if not np.isfinite(norm).all() or norm.min() < 1e-12:
        return _nothing("no pose was found")
    distance = (np.einsum("ni,ni->n", lines[:, :2], pixels_b) + lines[:, 2]) / norm
    predicted = pixels_b - distance[:, None] * lines[:, :2] / norm[:, None]
    inliers = int(found.inliers.sum())
    how = f"no depth: nearest place on the epipolar line, {inliers} inliers"
    return Carried(matches, predicted, np.abs(distance), inliers, how)


def _nothing(how: str) -> Carried:
    return Carried(np.zeros((0, 2), np.int64), np.zeros((0, 2)), np.zeros(0), 0, how)


def _panel(image: UInt8, width: int) -> Canvas:
    return Canvas(image, width=width)


def _fill(colour: tuple[int, int, int], count: int) -> NDArray[np.uint8]:
    return np.tile(np.array(colour, np.uint8), (count, 1))
