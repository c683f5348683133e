"""The part of a run that is exported: the poses of one segment, its good points, and their observations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.files import write_png
from improvo.geometry import se3
from improvo.odometry.run.point_colours import UNKNOWN
from improvo.odometry.run.run_folder import RunFolder
from improvo.types import Float64, Int64, UInt8


@dataclass(frozen=True)
class Model:
    """One segment; points and observations refer to `frames` by row."""

    frames: Int64  # (F,) frame_index of each
    cam_from_world: Float64  # (F, 4, 4)
    xyz: Float64  # (P, 3)
    stability: Int64  # (P,) label codes
    rgb: UInt8  # (P, 3) of the map point that the track belongs to; grey where it belongs to none
    frame: Int64  # (M,) row of `frames`, sorted by point, then frame
    point: Int64  # (M,) row of `xyz`
    keypoints: Float64  # (M, 2) pixels, the centre of the top-left pixel at (0, 0)
    error: Float64  # (M,) pixels

    @property
    def mean_error(self) -> float:
        """Mean re-projection error in pixels, as COLMAP has it: the mean over points of each point's mean."""
        return float(self.point_errors().mean()) if len(self.xyz) else 0.0

    def point_errors(self) -> Float64:
        """(P,) mean error of each point."""
        total = np.bincount(self.point, weights=self.error, minlength=len(self.xyz))
        return total / np.maximum(np.bincount(self.point, minlength=len(self.xyz)), 1)


def segment_model(run: RunFolder, segment: int, max_error: float = 4.0, min_observations: int = 3) -> Model:
    """The model of one segment: tracks with their robust points, without links that do not fit.

    Args:
        run: the finished run.
        segment: its number.
        max_error: pixels; observations with a larger re-projection error are left out.
        min_observations: points with fewer remaining ones are left out.
    """
    rows = np.flatnonzero(run.trajectory.segment == segment)
    frames = run.frame_indices[rows]
    cam_from_world = se3.inverse(run.trajectory.world_from_cam[rows])
    row_of_frame = np.full(run.frames, -1, np.int64)
    row_of_frame[frames] = np.arange(len(frames))

    usable = np.flatnonzero((run.points.segment == segment) & np.isfinite(run.points.xyz).all(axis=1))
    usable = usable[np.argsort(run.points.track[usable])]
    ids = run.points.track[usable]
    tracks = run.tracks
    found = np.minimum(np.searchsorted(ids, tracks.track), max(len(ids) - 1, 0))
    of_point = (ids[found] == tracks.track) if len(ids) else np.zeros(len(tracks), bool)
    seen = np.flatnonzero(of_point & (row_of_frame[tracks.frame] >= 0))
    frame, point = row_of_frame[tracks.frame[seen]], found[seen]
    keypoints = tracks.keypoints[seen].astype(np.float64)
    xyz = run.points.xyz[usable]

    in_camera = np.einsum("nij,nj->ni", cam_from_world[frame, :3, :3], xyz[point]) + cam_from_world[frame, :3, 3]
    front = in_camera[:, 2] > 1e-9
    error = np.full(len(seen), np.inf)
    error[front] = np.linalg.norm(run.camera.project(in_camera[front]) - keypoints[front], axis=1)
    good = error <= max_error
    enough = np.bincount(point[good], minlength=len(xyz)) >= min_observations
    good &= enough[point]
    new_row = np.cumsum(enough) - 1
    rgb = np.full((len(xyz), 3), UNKNOWN, np.uint8)
    if run.map.rgb is not None:
        row = run.map.rows_of(run.points.point[usable])
        rgb[row >= 0] = run.map.rgb[row[row >= 0]]
    return Model(
        frames,
        cam_from_world,
        xyz[enough],
        run.points.stability[usable][enough].astype(np.int64),
        rgb[enough],
        frame[good],
        new_row[point[good]],
        keypoints[good],
        error[good],
    )


def segments_by_length(run: RunFolder) -> list[int]:
    """Numbers of the segments, the longest first.

    Raises:
        InputError: no frame has a pose.
    """
    numbers, counts = np.unique(run.trajectory.segment, return_counts=True)
    if len(numbers) == 0:
        raise InputError(f"{run.path}: no frame has a pose, so there is nothing to export; see `events` in run.json")
    return [int(number) for number in numbers[np.argsort(-counts, kind="stable")]]


def image_name(frame: int) -> str:
    """The file name of a frame in an export."""
    return f"frame_{frame:06d}.png"


def write_images(run: RunFolder, model: Model, folder: Path, advance: Callable[[], None] = lambda: None) -> UInt8:
    """Write the frames, undistorted as the run saw them; returns the RGB (P, 3) of each point where first seen.

    Args:
        run: whose recording they come from.
        model: whose frames.
        folder: made if need be.
        advance: is called after every frame.
    """
    colours = model.rgb.copy()
    first = np.flatnonzero(np.diff(model.point, prepend=-1))
    pixels = np.rint(model.keypoints[first]).astype(np.int64)
    for row, frame in enumerate(model.frames.tolist()):
        image = run.colour(frame)
        write_png(folder / image_name(frame), image)
        here = np.flatnonzero(model.frame[first] == row)
        v = np.clip(pixels[here, 1], 0, image.shape[0] - 1)
        u = np.clip(pixels[here, 0], 0, image.shape[1] - 1)
        colours[model.point[first[here]]] = image[v, u]
        advance()
    return colours
