"""The output folder of `improvo run` or `improvo label`, read back for pictures and exports."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from improvo import config
from improvo.errors import InputError
from improvo.files import check_folder_format
from improvo.formats import FORMAT_KEY, check_format
from improvo.geometry.camera import Camera
from improvo.geometry.trajectory_files import read_trajectory
from improvo.odometry.map_file import read_map
from improvo.odometry.run import unit_of
from improvo.odometry.verdict.told_verdicts import doubtful_frames, uncertain_frames
from improvo.sequences import Sequence, SequenceSettings, open_sequence
from improvo.stability.rule import IGNORE
from improvo.stability.tables import POINTS_FILE, TRACKS_FILE, PointsTable, TracksTable, read_points, read_tracks
from improvo.types import Float64, Int64, Mask, SparseMap, Trajectory, UInt8
from improvo.untrusted.paths import as_text, check_path
from improvo.untrusted.text import read_json_file, reason

_FORMER_KINDS = {"waiting": "initialising"}  # of events
_MENDS = {  # by a word of the reason
    "parallax": "the camera turned or stood still: move it sideways at the start (`improvo info` shows what it sees)",
    "match": "neighbouring frames show too little of the same place: give all frames of the video, without --stride, "
    "or see by `improvo info` whether the pictures are dark, blurred or without texture",
}


@dataclass(frozen=True)
class Observations:
    """What one frame saw, one row per track."""

    track: Int64  # (N,)
    keypoints: Float64  # (N, 2) pixels
    error: Float64  # (N,) pixels, NaN where there is none
    age: Int64  # (N,) frames since the track began
    stability: NDArray[np.int8]  # (N,) label of the track

    def __len__(self) -> int:
        return len(self.track)


class RunFolder:
    """Reads what is asked for, when it is asked for.

    Args:
        path: the folder.
        sequence_path: where the recording is now; by default where run.json says it was.

    Raises:
        InputError: the folder has no readable run.json.
    """

    def __init__(self, path: Path | str, sequence_path: Path | None = None) -> None:
        self.path = path = Path(path)
        self._sequence_path = sequence_path
        if not path.is_dir():
            raise InputError(f"{path}: no such folder; give the output folder of `improvo run`")
        try:
            check_folder_format(path)
            report = _with_present_names(read_json_file(path / "run.json", "run `improvo run` again"))
            self.report: dict[str, Any] = _told_where(report, f"{path / 'run.json'}")
            check_format(self.report.get(FORMAT_KEY), path / "run.json", "run `improvo run` again")
            self.recorded_input = check_path(Path(self.report["input"]["path"]))
            self.source_index: list[int] = self.report["frames"]["source_index"]
            _check(self.report)
        except FileNotFoundError:
            raise InputError(f"{path}: has no run.json; give the output folder of `improvo run`") from None
        except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
            raise InputError(f"{path / 'run.json'}: cannot be read ({error}); run `improvo run` again") from None

    @property
    def name(self) -> str:
        """The recording's name."""
        return as_text(self.recorded_input.name or str(self.recorded_input))

    @property
    def unit(self) -> str:
        """Of lengths, in words: metres and from what they are known, or up to scale."""
        return unit_of(self.report)

    @property
    def frames(self) -> int:
        """Number of processed frames; a `frame_index` is 0 to this, exclusive."""
        return len(self.source_index)

    @cached_property
    def camera(self) -> Camera:
        """The pinhole camera of the processed frames."""
        try:
            return Camera(**self.report["camera"])
        except (TypeError, ValueError, InputError) as error:
            words = f"holds no camera ({reason(error)})"
            raise InputError(f"{self.path / 'run.json'}: {words}; run `improvo run` again") from None

    @cached_property
    def trajectory(self) -> Trajectory:
        """Poses of the frames that have one, maybe none."""
        if self.report["frames"]["tracked"] == 0:  # a file without poses is otherwise an error
            return Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
        return read_trajectory(self.path / "trajectory.txt")

    @cached_property
    def frame_indices(self) -> Int64:
        """(N,) the `frame_index` of each row of `trajectory`."""
        lost = set(self.report["frames"]["lost_frames"])
        frame_indices = np.array([p for p in range(self.frames) if p not in lost], np.int64)
        if len(frame_indices) != len(self.trajectory):
            raise InputError(
                f"{self.path}: trajectory.txt has {len(self.trajectory)} poses and run.json {len(frame_indices)}; "
                "run again"
            )
        return frame_indices

    @cached_property
    def doubtful(self) -> Mask:
        """(N,) whether the verdict of the segment is doubtful, for each row of `trajectory`."""
        return doubtful_frames(self.report, self.trajectory.segment)

    @cached_property
    def uncertain(self) -> Mask:
        """(N,) whether the scale is not determined there, for each row of `trajectory`."""
        return uncertain_frames(self.report, self.frame_indices)

    @cached_property
    def map(self) -> SparseMap:
        """The map points."""
        return read_map(self.path / "map.ply")

    @cached_property
    def points(self) -> PointsTable:
        """The labels, one row per track."""
        return read_points(self.path / POINTS_FILE)

    @cached_property
    def tracks(self) -> TracksTable:
        """The observations, sorted by track, then frame."""
        return read_tracks(self.path / TRACKS_FILE)

    @cached_property
    def sequence(self) -> Sequence:
        """The recording, opened as it was for the run."""
        settings = config.from_dict(SequenceSettings, self.report["configuration"]["sequence"], "run.json")
        own = self.path / "camera.yaml"  # found for this run (`--camera auto`), which may have been moved
        if settings.camera is not None and own.is_file() and Path(settings.camera).name == own.name:
            settings = replace(settings, camera=str(own))
        path = check_path(self._sequence_path or self.recorded_input, reachable=True)
        if not path.exists():
            raise InputError(f"{path}: the recording is not there any more; name it with --sequence PATH")
        sequence = open_sequence(path, settings)
        if (sequence.camera.width, sequence.camera.height) != (self.camera.width, self.camera.height):
            raise InputError(f"{path}: its frames have another size than those of the run; name the right one")
        return sequence

    @cached_property
    def _row_of_index(self) -> dict[int, int]:
        return {int(index): row for row, index in enumerate(self.sequence.indices)}

    def image(self, frame_index: int) -> UInt8:
        """The grey image (H, W) of a processed frame.

        Raises:
            InputError: there is no such frame in the run or in the recording.
        """
        return self.sequence[self._row(frame_index)].image

    def colour(self, frame_index: int) -> UInt8:
        """The same in colour, (H, W, 3) RGB; three equal channels where the recording has none."""
        return np.ascontiguousarray(self.sequence.colour(self._row(frame_index))[..., ::-1])

    def _row(self, frame_index: int) -> int:
        """The row of the recording's sequence that a processed frame is."""
        if not 0 <= frame_index < self.frames:
            raise InputError(f"{self.path}: has no frame {frame_index}; frames are 0 to {self.frames - 1}")
        row = self._row_of_index.get(self.source_index[frame_index])
        if row is None:
            raise InputError(
                f"{self.sequence.path}: has no frame {self.source_index[frame_index]}; is it the recording?"
            )
        return row

    @cached_property
    def _first_rows(self) -> tuple[Int64, Int64]:
        """Row of each track's first observation, and the track's index per observation."""
        starts = np.flatnonzero(np.diff(self.tracks.track, prepend=-1))
        lengths = np.diff(np.append(starts, len(self.tracks)))
        return starts, np.repeat(np.arange(len(starts)), lengths)

    @cached_property
    def _rows_by_frame(self) -> tuple[Int64, Int64]:
        order = np.argsort(self.tracks.frame, kind="stable")
        return order, np.searchsorted(self.tracks.frame[order], np.arange(self.frames + 1))

    def rows_at(self, frame_index: int) -> Int64:
        """Rows of `tracks` that belong to one frame."""
        order, bounds = self._rows_by_frame
        return order[bounds[frame_index] : bounds[frame_index + 1]]

    @cached_property
    def birth(self) -> Int64:
        """(M,) the frame in which each observation's track began."""
        starts, index = self._first_rows
        return self.tracks.frame[starts][index]

    @cached_property
    def stability_of_rows(self) -> NDArray[np.int8]:
        """(M,) the label of each observation's track."""
        starts, index = self._first_rows
        ids = self.tracks.track[starts]
        order = np.argsort(self.points.track)
        if len(order) == 0:
            return np.full(len(self.tracks), IGNORE, np.int8)
        found = np.minimum(np.searchsorted(self.points.track[order], ids), len(order) - 1)
        labels = np.where(self.points.track[order[found]] == ids, self.points.stability[order[found]], IGNORE)
        return labels[index].astype(np.int8)

    def rows_of(self, frame_index: int, tracks: Int64) -> Int64:
        """Rows of `tracks` where one frame saw the given tracks, -1 where it did not."""
        rows = self.rows_at(frame_index)
        ids = self.tracks.track[rows]  # increasing: the table is sorted by track
        if len(ids) == 0:
            return np.full(len(tracks), -1, np.int64)
        found = np.minimum(np.searchsorted(ids, tracks), len(ids) - 1)
        return np.where(ids[found] == tracks, rows[found], -1)

    def observations(self, frame_index: int) -> Observations:
        """The tracks of one frame."""
        rows = self.rows_at(frame_index)
        return Observations(
            self.tracks.track[rows],
            self.tracks.keypoints[rows].astype(np.float64),
            self.tracks.error[rows].astype(np.float64),
            frame_index - self.birth[rows],
            self.stability_of_rows[rows],
        )


def why_no_pose(report: dict[str, Any]) -> str | None:
    """Why no frame of a run has a pose, and what helps, from its run.json; None where some have."""
    if report["frames"]["tracked"]:
        return None
    details = [str(event["detail"]) for event in report["events"] if event["kind"] == "initialising"]
    reason = details[-1] if details else "the run ended before a map could start"
    mend = next((mend for word, mend in _MENDS.items() if word in reason), _MENDS["match"])
    return f"no frame has a pose: {reason}; {mend}"


class _Section(dict[str, Any]):
    """A part of run.json; what it lacks is an error of the file, wherever it is asked for."""

    where = ""

    def __missing__(self, key: object) -> Any:
        raise InputError(f"{self.where}: has no `{key}`; run `improvo run` again")


def _told_where(value: Any, where: str) -> Any:
    """The same with every dictionary a section that knows its file."""
    if isinstance(value, list):
        return [_told_where(item, where) if isinstance(item, dict | list) else item for item in value]
    if not isinstance(value, dict):
        return value
    section = _Section({key: _told_where(item, where) for key, item in value.items()})
    section.where = where
    return section


def _check(report: dict[str, Any]) -> None:
    """Refuse a run.json that is not as `improvo run` writes it.

    Raises:
        ValueError, KeyError, TypeError: it is not.
    """
    frames, indices = report["frames"], report["frames"]["source_index"]
    lists = [indices, frames["lost_frames"], [frames["tracked"]]]
    if not all(isinstance(row, list) and all(type(number) is int for number in row) for row in lists):
        raise ValueError("its frames are no numbers")
    if any(b <= a for a, b in pairwise(indices)) or not all(0 <= number < 1 << 40 for number in indices):
        raise ValueError("its frames are out of order")
    if not all(isinstance(report.get(name, {}), dict) for name in ("camera", "configuration")):
        raise ValueError("its camera or configuration has no names")
    for event in report["events"]:
        if not isinstance(event["kind"], str):
            raise ValueError("an event is of no kind")


def _with_present_names(report: dict[str, Any]) -> dict[str, Any]:
    """The content of run.json, also of one that was written when events and settings had other names."""
    events = [
        {("frame_index" if key == "position" else key): value for key, value in event.items()}
        for event in report.get("events", [])
    ]
    for event in events:
        event["kind"] = _FORMER_KINDS.get(event["kind"], event["kind"])
    return {**report, "events": events, "configuration": config.with_present_names(report.get("configuration", {}))}
