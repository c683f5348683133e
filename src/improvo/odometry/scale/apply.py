"""A run in metres: trajectory, map and points of a folder, each segment by its own scale."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, TypeVar

import numpy as np

from improvo.errors import InputError
from improvo.files import write_json
from improvo.geometry.trajectory_files import write_trajectory
from improvo.odometry.run.map_file import read_map, write_map
from improvo.odometry.run.run_odometry import RunSummary
from improvo.odometry.scale.estimate import ScaleEstimate
from improvo.odometry.scale.settings import ScaleSettings
from improvo.odometry.scale.sources import Ask
from improvo.odometry.scale.tracked import TrackedRun
from improvo.sequences import Sequence
from improvo.stability.tables import POINTS_FILE, PointsWriter, read_points
from improvo.types import Float64, Int64, Trajectory

Run = TypeVar("Run", bound=RunSummary)
_WORDS = {
    "depth": "from depth images",
    "truth": "from a trajectory in metres",
    "distance": "from a known distance",
    "height": "from the camera's height over the ground",
    "marker": "from markers of known size",
}


@dataclass(frozen=True)
class SegmentMap:
    """x_new = factor (x - old) + new, for the world of one segment."""

    factor: float
    old: Float64  # (3,)
    new: Float64  # (3,)

    def apply(self, points: Float64) -> Float64:
        """Points (..., 3)."""
        return np.asarray(self.factor * (points - self.old) + self.new)


def apply_scale(sequence: Sequence, run: Run, ask: Ask, settings: ScaleSettings) -> Run:
    """Bring the outputs of a run to metres; those of a segment whose scale is not known keep the one before it.

    Args:
        sequence: the frames of the run.
        run: finished, up to scale; its files are written again.
        ask: what `scale_source` gave.
        settings: what it was made with.

    Raises:
        InputError: the source cannot say, or contradicts itself; the files are left as they are.
    """
    if not run.tracked:
        return run
    try:
        estimates = ask(TrackedRun(sequence, run))
    except InputError as error:
        raise InputError(f"{error}; {run.folder} holds the run, up to scale") from None
    maps = segment_maps(run.trajectory, estimates)
    trajectory = scaled_trajectory(run.trajectory, maps)
    report = {**run.report, **_entry(estimates, len(maps), settings)}
    unit = report["scale"]
    sparse_map, points = read_map(run.folder / "map.ply"), read_points(run.folder / POINTS_FILE)
    points = replace(points, xyz=_scaled(points.xyz, points.segment, maps))
    (run.folder / "run.json").unlink(missing_ok=True)  # until all files are in one unit, there is no result
    write_map(run.folder / "map.ply", replace(sparse_map, xyz=_scaled(sparse_map.xyz, sparse_map.segment, maps)), unit)
    with PointsWriter(run.folder / POINTS_FILE) as writer:
        writer.write(points)
    write_trajectory(run.folder / "trajectory.txt", trajectory, unit=unit)
    write_json(run.folder / "run.json", report)
    return replace(run, trajectory=trajectory, report=report)


def segment_maps(trajectory: Trajectory, estimates: dict[int, ScaleEstimate]) -> dict[int, SegmentMap]:
    """How each segment is scaled: about where it began, which is where the camera was in the last frame before it.

    That frame is of any earlier segment: one that is seen again later goes on behind the segments after it.
    """
    maps: dict[int, SegmentMap] = {}
    factor = next(iter(estimates.values())).metres_per_unit
    posed = np.flatnonzero(trajectory.segment >= 0)
    numbers = trajectory.segment[posed]
    for place in np.sort(np.unique(numbers, return_index=True)[1]).tolist():  # the first frame of each
        old = new = np.zeros(3)
        if place > 0:
            old = trajectory.camera_centers[posed[place - 1]]
            new = maps[int(numbers[place - 1])].apply(old)
        segment = int(numbers[place])
        factor = estimates[segment].metres_per_unit if segment in estimates else factor
        maps[segment] = SegmentMap(factor, old, new)
    return maps


def scaled_trajectory(trajectory: Trajectory, maps: dict[int, SegmentMap]) -> Trajectory:
    """The trajectory with each segment scaled."""
    poses = np.array(trajectory.world_from_cam)
    poses[:, :3, 3] = _scaled(poses[:, :3, 3], trajectory.segment, maps)
    return replace(trajectory, world_from_cam=poses)


def _scaled(points: Float64, segment: Int64, maps: dict[int, SegmentMap]) -> Float64:
    result = np.array(points)
    for number, each in maps.items():
        result[segment == number] = each.apply(points[segment == number])
    return result


def _entry(estimates: dict[int, ScaleEstimate], segments: int, settings: ScaleSettings) -> dict[str, Any]:
    """What run.json says about it."""
    first = next(iter(estimates.values()))
    words = "from known distances" if len(settings.distances) > 1 else _WORDS[settings.source]
    text = f"metres, {words}"
    text += f" ({first.surety})" if first.surety else ""
    unknown = [number for number in range(segments) if number not in estimates]
    if unknown:
        text += f"; of segment {', '.join(map(str, unknown))} a guess"
    return {
        "scale": text,
        "metric": {
            "source": settings.source,
            "segments": [{"segment": number, **asdict(estimate)} for number, estimate in estimates.items()],
            "segments_without": unknown,
        },
    }
