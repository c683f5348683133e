"""Which frames a frame is compared with: enough baseline, little turn, on both sides."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from improvo.depth.settings import NeighbourSettings
from improvo.geometry import se3
from improvo.types import Float64

_GRID = 5  # points across and down that show how much two frames share


def choose_neighbours(
    cam_from_world: Float64,
    K: Float64,
    size: tuple[int, int],
    frame: int,
    candidates: Sequence[int],
    median_depth: float,
    settings: NeighbourSettings,
) -> list[int]:
    """Frames to compare `frame` with, in temporal order; empty where there are fewer than `settings.least`.

    Of each side (before and after), baselines spread evenly between the smallest and the largest allowed are wanted;
    each takes the nearest candidate that is left.

    Args:
        cam_from_world: (N, 4, 4) poses; rows with NaN are no candidates.
        K: (3, 3) of images of `size`.
        size: width and height in pixels.
        frame: row of the frame.
        candidates: rows that may be chosen; the frame itself and repetitions do not count.
        median_depth: of the frame, in the unit of the poses.
        settings: the rules.
    """
    rows = np.array(sorted({int(row) for row in candidates} - {frame}), np.int64)
    rows = rows[np.isfinite(cam_from_world[rows]).all(axis=(1, 2))]
    if len(rows) == 0 or not np.isfinite(cam_from_world[frame]).all():
        return []
    other_from_frame = cam_from_world[rows] @ se3.inverse(cam_from_world[frame])
    baseline = np.linalg.norm(other_from_frame[:, :3, 3], axis=1) / median_depth
    allowed = (
        (baseline >= settings.min_baseline)
        & (baseline <= settings.max_baseline)
        & (se3.rotation_angle_deg(other_from_frame[:, :3, :3]) <= settings.max_turn_deg)
    )
    rows, other_from_frame, baseline = rows[allowed], other_from_frame[allowed], baseline[allowed]
    shared = _overlap(other_from_frame, K, size, median_depth) >= settings.min_overlap
    rows, baseline = rows[shared], baseline[shared]
    before, after = np.flatnonzero(rows < frame), np.flatnonzero(rows > frame)
    chosen: list[int] = []
    half = settings.most // 2
    quota = (max(settings.most - half, settings.most - len(after)), max(half, settings.most - len(before)))
    for side, count in zip((before, after), quota, strict=True):
        chosen += _spread(rows[side], baseline[side], min(count, settings.most - len(chosen)), settings)
    return sorted(chosen) if len(chosen) >= settings.least else []


def _spread(rows: np.ndarray, baseline: Float64, count: int, settings: NeighbourSettings) -> list[int]:
    """At most `count` rows whose baselines lie near evenly spaced ones."""
    if len(rows) <= count:
        return [int(row) for row in rows]
    left = baseline.copy()
    chosen = []
    for wanted in np.linspace(settings.max_baseline, settings.min_baseline, count + 1)[:-1]:
        nearest = int(np.argmin(np.abs(left - wanted)))
        chosen.append(int(rows[nearest]))
        left[nearest] = np.inf
    return chosen


def _overlap(other_from_frame: Float64, K: Float64, size: tuple[int, int], depth: float) -> Float64:
    """(N,) share of a grid of points at `depth` that the other frames show."""
    width, height = size
    columns, rows = np.meshgrid(np.linspace(0, width - 1, _GRID), np.linspace(0, height - 1, _GRID))
    pixels = np.stack([columns.ravel(), rows.ravel(), np.ones(_GRID * _GRID)])
    points = (depth * np.linalg.inv(K) @ pixels).T
    seen = se3.transform(other_from_frame, points) @ K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = seen[..., 0] / seen[..., 2], seen[..., 1] / seen[..., 2]
    inside = (seen[..., 2] > 0) & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    return np.asarray(inside.mean(axis=1))
