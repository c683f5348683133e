"""Between which depths a frame is searched: from sparse depths, or by a coarse sweep where there are none."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from improvo.depth.depth_map import DepthMap, half_intrinsics
from improvo.depth.plane_sweep import sweep_prepared
from improvo.depth.prepared_image import PreparedImage, prepare_image
from improvo.depth.settings import DepthSettings
from improvo.geometry import se3
from improvo.types import Float32, Float64, Int64

NEAREST, FARTHEST = 0.01, 0.99  # quantiles of the depths
LEAST_DEPTHS = 10
_NEARER, _FARTHER = 0.75, 1.5  # the range goes beyond the quantiles by these factors
_BASELINES = 6  # tried by the search, each about half the one before
_SEARCHED = (2.0, 60.0)  # depths of the search, in baselines
_LEAST_KNOWN = 0.01  # share of the pixels that the search must know


def range_of_depths(depths: Float64 | Float32) -> tuple[float, float, float] | None:
    """Nearest, median and farthest depth for a sweep, from depths in the frame such as those of its map points.

    The range goes beyond the 1 % and 99 % quantiles by a quarter and by a half. None from fewer than ten depths.
    """
    finite = depths[np.isfinite(depths) & (depths > 0)]
    if len(finite) < LEAST_DEPTHS:
        return None
    near, median, far = np.quantile(finite, (NEAREST, 0.5, FARTHEST)).tolist()
    return widened(near, median, far)


def widened(near: float, median: float, far: float) -> tuple[float, float, float]:
    """The range of a sweep from the quantiles of depths."""
    return _NEARER * near, median, _FARTHER * far


def search_depth_range(
    prepare: Callable[[int], PreparedImage],
    cam_from_world: Float64,
    K: Float64,
    frame: int,
    candidates: Sequence[int],
    settings: DepthSettings,
) -> tuple[float, float, float] | None:
    """As `range_of_depths`, from coarse sweeps at a quarter of the frame's size over shorter and shorter baselines.

    The sweep that knows most pixels decides. None where none knows enough: no motion, or nothing to match.

    Args:
        prepare: the prepared image of a row.
        cam_from_world: (N, 4, 4) poses.
        K: (3, 3) of the prepared images.
        frame: row of the frame.
        candidates: rows of possible neighbours.
        settings: the neighbours' largest turn, and the sweep's thresholds.
    """
    rows = np.array(sorted({int(row) for row in candidates} - {frame}), np.int64)
    rows = rows[np.isfinite(cam_from_world[rows]).all(axis=(1, 2))]
    if len(rows) == 0 or not np.isfinite(cam_from_world[frame]).all():
        return None
    other_from_frame = cam_from_world[rows] @ se3.inverse(cam_from_world[frame])
    baseline = np.linalg.norm(other_from_frame[:, :3, 3], axis=1)
    usable = se3.rotation_angle_deg(other_from_frame[:, :3, :3]) <= settings.neighbours.max_turn_deg
    usable &= baseline > 0
    rows, other_from_frame, baseline = rows[usable], other_from_frame[usable], baseline[usable]
    if len(rows) < settings.neighbours.least:
        return None
    reference = _halved(prepare(frame))
    best: DepthMap | None = None
    tried: set[tuple[int, ...]] = set()
    for wanted in baseline.max() * 0.5 ** np.arange(_BASELINES):
        chosen = _nearest_on_both_sides(rows, baseline, frame, wanted)
        if tuple(chosen) in tried:
            continue
        tried.add(tuple(chosen))
        found = sweep_prepared(
            reference,
            [_halved(prepare(int(rows[i]))) for i in chosen],
            other_from_frame[chosen],
            half_intrinsics(K),
            (_SEARCHED[0] * wanted, _SEARCHED[1] * wanted),
            settings.sweep,
        )
        if best is None or found.known > best.known:
            best = found
    if best is None or best.known < _LEAST_KNOWN:
        return None
    return range_of_depths(best.depth[best.depth > 0])


def _nearest_on_both_sides(rows: Int64, baseline: Float64, frame: int, wanted: float) -> list[int]:
    """Indices of two rows before and two after the frame whose baselines are nearest to the wanted one."""
    order = np.argsort(np.abs(baseline - wanted), kind="stable")
    before, after = order[rows[order] < frame], order[rows[order] > frame]
    return sorted(np.concatenate([before[: max(2, 4 - len(after))], after[: max(2, 4 - len(before))]]).tolist())


def _halved(image: PreparedImage) -> PreparedImage:
    return prepare_image(image.grey)
