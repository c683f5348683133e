"""Which tracks went wrong in one link, and which follow a thing that moves: how the error of a track came about.

A track is unstable if one of its errors is large, whatever the reason. Where a thing moves, the vector from the
projection to the keypoint changes a little in every frame; where a link was wrong, it jumps once. On simulated rooms
six in ten tracks on moving things, and seven in a hundred on static ones, have no step of more than a quarter of the
way that the vector went in all.
"""

from __future__ import annotations

import numpy as np

from improvo.geometry.se3 import transform
from improvo.labeling.labeled import LabeledSequence
from improvo.stability.grouping import rows_of
from improvo.stability.rule import UNSTABLE
from improvo.types import Float64


def largest_step_shares(sequence: LabeledSequence) -> Float64:
    """Of every unstable track, its largest step as a share of the way (T,); NaN for all others.

    The way is the diagonal of the box about all of the track's error vectors.
    """
    tracks, points = sequence.tracks, sequence.points
    row = rows_of(points.track, tracks.track)
    wanted = np.flatnonzero(points.stability[row] == UNSTABLE)  # few of all, and a pose for each of them is gathered
    order = wanted[np.lexsort((tracks.frame[wanted], row[wanted]))]
    row, frame = row[order], tracks.frame[order].astype(np.int64)
    xyz = points.xyz[row].astype(np.float64)
    in_camera = transform(sequence.cam_from_world[frame], xyz[:, None])[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        error = tracks.keypoints[order] - sequence.camera.project(in_camera)  # (M, 2)
    known = np.isfinite(error).all(axis=1) & (in_camera[:, 2] > 0)
    row, frame, error = row[known], frame[known], error[known]
    low, high = np.full((2, len(points), 2), np.inf)
    high = -high
    np.minimum.at(low, row, error)
    np.maximum.at(high, row, error)
    linked = row[1:] == row[:-1]
    step = np.zeros(len(points))
    np.maximum.at(step, row[1:][linked], np.linalg.norm(np.diff(error, axis=0)[linked], axis=1))
    with np.errstate(divide="ignore", invalid="ignore"):
        way = np.linalg.norm(high - low, axis=1)
        return np.where(np.isfinite(way), step / way, np.nan)
