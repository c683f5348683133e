"""Dense depth of a run: what `improvo run --dense` adds to its folder."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from improvo.depth.archive import DEPTH_FILE, DepthWriter
from improvo.depth.cloud import DenseCloud, write_cloud
from improvo.depth.depth_map import DepthMap, half_intrinsics
from improvo.depth.depth_maps import depth_maps
from improvo.depth.settings import DepthSettings
from improvo.depth.sparse_depths import ranges_of_run
from improvo.errors import InputError
from improvo.files import write_json
from improvo.geometry import se3
from improvo.odometry.run.run_json import metres_per_unit
from improvo.odometry.run.run_odometry import RunSummary
from improvo.sequences import Sequence
from improvo.sequences.images import grey
from improvo.stability.tables import POINTS_FILE, TRACKS_FILE
from improvo.types import Float64, Mask, UInt8

CLOUD_FILE = "dense.ply"


def refuse_live(sequence: Sequence) -> None:
    """Dense depth reads every frame a second time.

    Raises:
        InputError: the sequence is live.
    """
    if sequence.length is None:
        raise InputError(f"{sequence.path}: is live, and dense depth reads every frame twice; record it first")


def write_dense(
    sequence: Sequence, summary: RunSummary, settings: DepthSettings, progress: Callable[[], object] = lambda: None
) -> dict[str, Any]:
    """Add `depth.zip` and `dense.ply` to the folder of a run, and the entry `depth` to its run.json.

    An interrupt (KeyboardInterrupt) ends the maps there; what there is so far is written as a valid result.

    Args:
        sequence: the frames of the run, once more.
        summary: of the run.
        settings: all numbers.
        progress: called after each of the frames that have a pose.

    Returns:
        The entry of run.json.

    Raises:
        InputError: the sequence is live.
    """
    refuse_live(sequence)
    started = time.perf_counter()
    folder, trajectory, camera = summary.folder, summary.trajectory, sequence.camera
    cam_from_world = np.full((len(trajectory), 4, 4), np.nan)
    cam_from_world[trajectory.valid] = se3.inverse(trajectory.world_from_cam[trajectory.valid])
    ranges = ranges_of_run(folder / POINTS_FILE, folder / TRACKS_FILE, cam_from_world, trajectory.segment)
    cam_from_world[~np.isfinite(ranges).all(axis=1)] = np.nan
    pictures = _Pictures(sequence, summary.report["frames"]["source_index"])
    numbers = [int(number) for number in np.unique(trajectory.segment) if number >= 0]
    units = {number: metres_per_unit(summary.report, number) for number in numbers}
    clouds = {unit: DenseCloud(settings.cloud, unit) for unit in units.values()}
    frames = pixels = known = 0
    interrupted = False
    with DepthWriter(folder / DEPTH_FILE, half_intrinsics(camera.K), summary.unit) as writer:
        try:
            for frame, depth_map in depth_maps(
                pictures.grey, cam_from_world, trajectory.segment, camera.K, lambda row: _triple(ranges[row]), settings
            ):
                depth_map = without_masked(depth_map, pictures.mask(frame))
                writer.write(frame, depth_map.depth)
                cloud = clouds[units[int(trajectory.segment[frame])]]
                cloud.add(depth_map, pictures.colour(frame), trajectory.world_from_cam[frame])
                frames, pixels = frames + 1, pixels + depth_map.depth.size
                known += int((depth_map.depth > 0).sum())
                progress()
        except KeyboardInterrupt:
            interrupted = True
    parts = [cloud.points() for cloud in clouds.values()]
    points = np.concatenate([np.zeros((0, 3)), *(xyz for xyz, _ in parts)])
    colours = np.concatenate([np.zeros((0, 3), np.uint8), *(rgb for _, rgb in parts)])
    write_cloud(folder / CLOUD_FILE, points, colours, summary.unit)
    entry = {
        "frames": frames,
        "pixels": pixels,
        "pixels_with_depth": known,
        "share": round(known / max(pixels, 1), 4),
        "points": len(points),
        "interrupted": interrupted,
        "seconds": round(time.perf_counter() - started, 3),
    }
    summary.report["depth"] = entry
    write_json(folder / "run.json", summary.report)
    return entry


def _triple(values: Float64) -> tuple[float, float, float]:
    near, median, far = values.tolist()
    return near, median, far


def without_masked(depth_map: DepthMap, mask: Mask | None) -> DepthMap:
    """The map without what any masked pixel (H, W) of the frame has a part in."""
    if mask is None:
        return depth_map
    height, width = depth_map.depth.shape
    four = mask[: 2 * height, : 2 * width].reshape(height, 2, width, 2).all(axis=(1, 3))
    depth, confidence = (np.where(four, values, np.float32(0)) for values in (depth_map.depth, depth_map.confidence))
    return replace(depth_map, depth=depth, confidence=confidence)


class _Pictures:
    """Frames by frame_index: grey once, in order, and afterwards their colours at half the size."""

    def __init__(self, sequence: Sequence, source_index: list[int]) -> None:
        self._sequence = sequence
        self._rows = np.searchsorted(sequence.indices, np.array(source_index, np.int64))
        self._colours: dict[int, UInt8] = {}

    def grey(self, frame: int) -> UInt8:
        """(H, W)."""
        colour = self._sequence.colour(int(self._rows[frame]))
        height, width = colour.shape[0] // 2, colour.shape[1] // 2
        cut = colour[: 2 * height, : 2 * width]
        self._colours[frame] = cv2.resize(cut, (width, height), interpolation=cv2.INTER_AREA)
        return grey(colour)

    def mask(self, frame: int) -> Mask | None:
        """Which pixels (H, W) are used; None are all."""
        return self._sequence.mask(int(self._rows[frame]))

    def colour(self, frame: int) -> UInt8:
        """(h, w, 3) BGR of a frame that was read, which is forgotten with this."""
        return self._colours.pop(frame)
