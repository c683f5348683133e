"""Between which depths each frame of a run is searched, from the triangulated tracks that it saw."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from improvo.depth.depth_range import FARTHEST, LEAST_DEPTHS, NEAREST, widened
from improvo.types import Float64, Int64

_MAX_ERROR = 2.0  # pixels, mean over the track
_MIN_PARALLAX_DEG = 1.0
_BINS, _SMALLEST, _LARGEST = 400, 1e-4, 1e4  # of the logarithm of depth: 4.7 % each
_ROWS = 1 << 18


def ranges_of_run(points: Path, tracks: Path, cam_from_world: Float64, segment: Int64) -> Float64:
    """(N, 3) nearest, median and farthest depth of each frame; NaN where its segment has no triangulated track.

    A frame that saw fewer than ten takes the range of the nearest frame of its segment. The tracks are read in pieces,
    so that memory does not grow with their number of observations.

    Args:
        points: `points.parquet`.
        tracks: `tracks.parquet`.
        cam_from_world: (N, 4, 4), NaN without a pose.
        segment: (N,), -1 without a pose.
    """
    histograms = _histograms(points, tracks, cam_from_world, segment)
    counts = histograms.sum(axis=1)
    ranges = np.full((len(segment), 3), np.nan)
    edges = np.geomspace(_SMALLEST, _LARGEST, _BINS + 1)
    middles = np.sqrt(edges[:-1] * edges[1:])
    enough = np.flatnonzero(counts >= LEAST_DEPTHS)
    for frame in enough.tolist():
        summed = np.cumsum(histograms[frame]) / counts[frame]
        near, median, far = middles[np.searchsorted(summed, (NEAREST, 0.5, FARTHEST))].tolist()
        ranges[frame] = widened(near, median, far)
    for frame in np.flatnonzero((counts < LEAST_DEPTHS) & (segment >= 0)).tolist():
        same = enough[segment[enough] == segment[frame]]
        if len(same):
            ranges[frame] = ranges[same[np.argmin(np.abs(same - frame))]]
    return ranges


def _histograms(points: Path, tracks: Path, cam_from_world: Float64, segment: Int64) -> Int64:
    """(N, bins) how many of the tracks that a frame saw lie at each depth."""
    import pyarrow.parquet as pq

    table = pq.read_table(points, columns=["track", "x", "y", "z", "mean_error", "segment", "parallax"])
    good = (table["mean_error"].to_numpy() < _MAX_ERROR) & (table["parallax"].to_numpy() > _MIN_PARALLAX_DEG)
    ids = table["track"].to_numpy()[good]
    order = np.argsort(ids)
    ids = ids[order]
    xyz = np.stack([table[axis].to_numpy()[good][order] for axis in "xyz"], axis=1)
    segment_of_track = table["segment"].to_numpy()[good][order]
    histograms = np.zeros((len(segment), _BINS), np.int64)
    if len(ids) == 0:
        return histograms
    steps = np.log(_LARGEST / _SMALLEST) / _BINS
    for batch in pq.ParquetFile(tracks).iter_batches(_ROWS, columns=["frame", "track"]):
        frame, track = batch["frame"].to_numpy(), batch["track"].to_numpy()
        row = np.minimum(np.searchsorted(ids, track), len(ids) - 1)
        seen = (ids[row] == track) & (segment[frame] == segment_of_track[row])
        frame, row = frame[seen], row[seen]
        z = (cam_from_world[frame, 2, :3] * xyz[row]).sum(axis=1) + cam_from_world[frame, 2, 3]
        frame, z = frame[z > 0], z[z > 0]
        bins = np.clip(np.floor(np.log(z / _SMALLEST) / steps), 0, _BINS - 1).astype(np.int64)
        np.add.at(histograms, (frame, bins), 1)
    return histograms
