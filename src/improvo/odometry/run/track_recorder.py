"""Writes finished tracks with the labels of the paper's rule while the odometry runs, so that memory stays bounded."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.odometry.result.final_view import FinalView
from improvo.stability.rule import label_stability
from improvo.stability.settings import LabelSettings
from improvo.stability.tables import POINTS_FILE, TRACKS_FILE, PointsWriter, TracksWriter
from improvo.types import Float32, Float64, Int64, Tracks

_FLUSH_EVERY = 200  # final frames


class TrackRecorder:
    """Writes `tracks.parquet` and `points.parquet` of raw connect-the-dots tracks, with every link they had.

    A track is written when it has ended and all frames that it passed are final, so the files are sorted by track only
    within what was written at once (see `improvo.stability.tables`). The labels are those of the rule alone: the
    quality gate comes afterwards (`improvo.labeling`). Use as a context manager: without an error, the files appear
    when the block ends.

    Args:
        folder: for the two files.
        camera: of the frames.
        settings: of the rule.
    """

    def __init__(self, folder: Path, camera: Camera, settings: LabelSettings) -> None:
        self._camera = camera
        self._settings = settings
        self._tracks_writer = TracksWriter(folder / TRACKS_FILE)
        self._points_writer = PointsWriter(folder / POINTS_FILE)
        self._pending: dict[int, FinalView] = {}  # final frames with tracks that are not written yet
        self._rest = _Rows.none()  # of unfinished tracks from frames before those
        self._next_frame = 0  # all frames before it are final
        self._poses: dict[int, tuple[Float64, int]] = {}  # of frames that unfinished tracks may refer to
        self.counts: Counter[str] = Counter()

    def __enter__(self) -> TrackRecorder:
        self._tracks_writer.__enter__()
        try:
            self._points_writer.__enter__()
        except BaseException as error:
            self._tracks_writer.__exit__(type(error), error, error.__traceback__)
            raise
        return self

    def __exit__(self, *error: object) -> None:
        try:
            if error[0] is None:
                self._flush(everything=True)
        except BaseException as failure:
            error = (type(failure), failure, failure.__traceback__)
            raise
        finally:
            try:
                self._points_writer.__exit__(*error)  # type: ignore[arg-type]
            except BaseException as failure:
                self._tracks_writer.__exit__(type(failure), failure, failure.__traceback__)
                raise
            self._tracks_writer.__exit__(*error)  # type: ignore[arg-type]

    def add(self, view: FinalView) -> None:
        """A frame became final (in any order)."""
        self._pending[view.frame_index] = view
        # while an early frame is not final, which takes long where the camera stands, no track is finished
        if len(self._pending) >= _FLUSH_EVERY and self._next_frame in self._pending:
            self._flush()

    def _flush(self, everything: bool = False) -> None:
        """Write the tracks that ended in frames all of whose neighbours are final."""
        parts = [self._rest]
        while self._next_frame in self._pending or (everything and self._pending):
            view = self._pending.pop(self._next_frame, None)
            if view is not None:
                parts.append(self._taken(view))
            self._next_frame += 1
        rows = _Rows.joined(parts).sorted()  # once for all frames: tracks that never end make the rest long
        if len(rows.frame) == 0:
            return
        last_frame = np.maximum.reduceat(rows.frame, rows.starts)
        # a chain has no gaps, so one that misses the newest final frame is over
        over = np.ones(len(last_frame), bool) if everything else last_frame < self._next_frame - 1
        finished = np.repeat(over, rows.lengths)
        self._write(rows.take(finished))
        self._rest = rows.take(~finished)
        oldest = int(self._rest.frame.min()) if len(self._rest.frame) else self._next_frame
        self._poses = {frame: pose for frame, pose in self._poses.items() if frame >= oldest}

    def _taken(self, view: FinalView) -> _Rows:
        """The rows of a final frame, whose pose is remembered."""
        pose = se3.inverse(view.world_from_cam) if view.segment >= 0 else np.full((4, 4), np.nan)
        self._poses[view.frame_index] = (pose, view.segment)
        frame = np.full(len(view.tracks), view.frame_index)
        keypoints, weights = view.keypoints.astype(np.float32), view.weights.astype(np.float32)
        return _Rows(frame, view.tracks, keypoints, weights, view.points)

    def _write(self, rows: _Rows) -> None:
        if len(rows.frame) == 0:
            return
        first = int(rows.frame.min())
        count = int(rows.frame.max()) + 1 - first
        cam_from_world = np.full((count, 4, 4), np.nan)
        segment = np.full(count, -1)
        for frame, (pose, number) in self._poses.items():
            if 0 <= frame - first < count:
                cam_from_world[frame - first], segment[frame - first] = pose, number
        tracks = Tracks(rows.frame - first, rows.track, rows.keypoints, rows.weight)
        labels = label_stability(
            tracks, cam_from_world, segment, self._camera.K, self._settings, point=rows.last_points()
        )
        self._tracks_writer.write(rows.frame, rows.track, tracks.keypoints, tracks.weight, labels.errors)
        self._points_writer.write(labels)
        self.counts.update(labels.counts())
        self.counts["tracks"] += len(labels)
        self.counts["observations"] += len(tracks)


class _Rows:
    """Observations as columns, one row each: (M,) frame, track, weight and point, (M, 2) keypoints."""

    def __init__(self, frame: Int64, track: Int64, keypoints: Float32, weight: Float32, point: Int64) -> None:
        self.frame, self.track, self.keypoints, self.weight, self.point = frame, track, keypoints, weight, point

    @classmethod
    def none(cls) -> _Rows:
        """No row."""
        number, real = np.zeros(0, np.int64), np.zeros(0, np.float32)
        return cls(number, number, real.reshape(0, 2), real, number)

    @classmethod
    def joined(cls, parts: list[_Rows]) -> _Rows:
        """All rows, one part after the other."""
        return cls(*(np.concatenate(columns) for columns in zip(*(part._columns for part in parts), strict=True)))

    @property
    def _columns(self) -> tuple[np.ndarray, ...]:
        return self.frame, self.track, self.keypoints, self.weight, self.point

    def take(self, rows: np.ndarray) -> _Rows:
        return _Rows(*(column[rows] for column in self._columns))

    def sorted(self) -> _Rows:
        """The rows by track, then frame."""
        return self.take(np.lexsort((self.frame, self.track)))

    @property
    def starts(self) -> Int64:
        """First row of each track; the rows are sorted."""
        return np.flatnonzero(np.diff(self.track, prepend=-1))

    @property
    def lengths(self) -> Int64:
        return np.diff(np.append(self.starts, len(self.track)))

    def last_points(self) -> Int64:
        """The map point that owns each track: the last one it observed, -1 for none."""
        rows = np.flatnonzero(self.point >= 0)
        index = np.repeat(np.arange(len(self.starts)), self.lengths)
        owner = np.full(len(self.starts), -1)
        owner[index[rows]] = self.point[rows]
        return owner
