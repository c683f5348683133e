"""`points.parquet` and `tracks.parquet`: their columns, streaming writers, and readers.

One file per sequence and kind, never one per image. Rows are written in groups while the odometry runs, to a temporary
name that becomes the real one when the writer closes, so that a reader never sees half a file.

Order of rows. A track is written when it has ended, so a file is sorted by track within each group that was written,
and not as a whole: a long track comes after shorter ones that began later. The readers sort: what `read_points` returns
is sorted by track, what `read_tracks` returns by track, then frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from improvo.errors import InputError
from improvo.files import written_atomically
from improvo.stability.rule import STABILITY_NAMES, TrackLabels
from improvo.stability.table_reading import read_parts, read_table
from improvo.types import Float32, Float64, Int64

if TYPE_CHECKING:
    import pyarrow as pa

POINTS_FILE, TRACKS_FILE = "points.parquet", "tracks.parquet"
_ROWS_PER_GROUP = 1 << 16


def points_schema() -> pa.Schema:
    """One row per track: what the labels are made of."""
    import pyarrow as pa

    return pa.schema(
        [
            ("track", pa.int64()),
            ("point", pa.int64()),  # map point, -1 where the map has none
            ("x", pa.float64()),
            ("y", pa.float64()),
            ("z", pa.float64()),
            ("observations", pa.int32()),
            ("mean_error", pa.float32()),  # pixels
            ("max_error", pa.float32()),
            ("stability", pa.dictionary(pa.int8(), pa.string())),
            ("segment", pa.int32()),  # x, y, z are in this segment's world
            ("parallax", pa.float32()),  # degrees, largest angle between two of its rays
            ("withheld", pa.bool_()),  # the quality gate took its label away
        ]
    )


def tracks_schema() -> pa.Schema:
    """One row per observation; the rows of a track stand together, in the order of frames. Tracks come in any order."""
    import pyarrow as pa

    return pa.schema(
        [
            ("frame", pa.int32()),  # index in the processed sequence
            ("track", pa.int64()),
            ("u", pa.float32()),  # pixels of the processed frames
            ("v", pa.float32()),
            ("weight", pa.float32()),  # w_ij
            ("error", pa.float32()),  # pixels under the final poses; NaN where there is none
        ]
    )


class _TableWriter:
    """Collects columns, writes a row group when enough rows have come."""

    def __init__(self, path: Path, schema: pa.Schema) -> None:
        self._path, self._schema = path, schema
        self._atomic: AbstractContextManager[Path] = written_atomically(path)
        self._pending: list[pa.RecordBatch] = []
        self._pending_rows = 0
        self.rows = 0

    def __enter__(self) -> Any:
        import pyarrow.parquet as pq

        self._temporary = self._atomic.__enter__()
        try:
            self._file = pq.ParquetWriter(self._temporary, self._schema, compression="zstd")
        except BaseException as error:
            self._atomic.__exit__(type(error), error, error.__traceback__)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._flush()
            self._file.close()
        except BaseException as failure:
            self._file.is_open = False  # or it tries again when it is freed, and prints a traceback
            self._atomic.__exit__(type(failure), failure, failure.__traceback__)
            raise
        self._atomic.__exit__(kind, error, trace)

    def _append(self, columns: list[Any]) -> None:
        import pyarrow as pa

        arrays = [pa.array(column, field.type) for column, field in zip(columns, self._schema, strict=True)]
        batch = pa.record_batch(arrays, schema=self._schema)
        self._pending.append(batch)
        self._pending_rows += batch.num_rows
        self.rows += batch.num_rows
        if self._pending_rows >= _ROWS_PER_GROUP:
            self._flush()

    def _flush(self) -> None:
        import pyarrow as pa

        if self._pending_rows:
            self._file.write_table(pa.Table.from_batches(self._pending, self._schema), row_group_size=1 << 20)
        self._pending, self._pending_rows = [], 0


class PointsWriter(_TableWriter):
    """`with PointsWriter(path) as points: points.write(labels)`: the file appears when the block ends without error."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, points_schema())

    def write(self, labels: TrackLabels | PointsTable) -> None:
        """Append one row per track."""
        import pyarrow as pa

        stability = pa.DictionaryArray.from_arrays(pa.array(labels.stability, pa.int8()), list(STABILITY_NAMES))
        self._append(
            [
                labels.track,
                labels.point,
                *np.asarray(labels.xyz).T,
                labels.observations.astype(np.int32),
                labels.mean_error.astype(np.float32),
                labels.max_error.astype(np.float32),
                stability,
                labels.segment.astype(np.int32),
                labels.parallax_deg.astype(np.float32),
                labels.withheld,
            ]
        )


class TracksWriter(_TableWriter):
    """`with TracksWriter(path) as tracks: tracks.write(...)`: the file appears when the block ends without error."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, tracks_schema())

    def write(self, frame: Int64, track: Int64, keypoints: Float32, weight: Float32, error: Float64) -> None:
        """Append whole tracks, one row per observation, sorted by track, then frame.

        Args:
            frame: (M,) index in the processed sequence.
            track: (M,) track id; no other call has rows of these tracks.
            keypoints: (M, 2) pixels.
            weight: (M,) observation confidence w_ij.
            error: (M,) pixels under the final poses; NaN where there is none.
        """
        keypoints = np.asarray(keypoints, np.float32)
        self._append(
            [
                np.asarray(frame, np.int32),
                np.asarray(track, np.int64),
                np.ascontiguousarray(keypoints[:, 0]),
                np.ascontiguousarray(keypoints[:, 1]),
                np.asarray(weight, np.float32),
                np.asarray(error, np.float32),
            ]
        )


@dataclass(frozen=True)
class PointsTable:
    """`points.parquet` in memory; as `read_points` returns it, sorted by track."""

    track: Int64  # (T,)
    point: Int64  # (T,) -1 where the map has none
    xyz: Float64  # (T, 3)
    observations: Int64  # (T,)
    mean_error: Float32  # (T,) pixels
    max_error: Float32  # (T,) pixels
    stability: NDArray[np.int8]  # (T,) codes of `improvo.stability.rule`
    segment: Int64  # (T,)
    parallax_deg: Float32  # (T,)
    withheld: NDArray[np.bool_]  # (T,) the quality gate took its label away

    def __len__(self) -> int:
        return len(self.track)

    def in_order(self) -> PointsTable:
        """The rows sorted by track; this table itself where they are."""
        if (np.diff(self.track) > 0).all():
            return self
        return _rows(self, np.argsort(self.track, kind="stable"))

    def counts(self) -> dict[str, int]:
        """Number of tracks per label, and of labels withheld."""
        by_code = np.bincount(self.stability, minlength=len(STABILITY_NAMES))
        names = {name: int(by_code[code]) for code, name in enumerate(STABILITY_NAMES)}
        return {**names, "withheld": int(self.withheld.sum())}


@dataclass(frozen=True)
class TracksTable:
    """`tracks.parquet` in memory; as `read_tracks` returns it, sorted by track, then frame."""

    frame: Int64  # (M,)
    track: Int64  # (M,)
    keypoints: Float32  # (M, 2)
    weight: Float32  # (M,)
    error: Float32  # (M,)

    def __len__(self) -> int:
        return len(self.frame)

    def in_order(self) -> TracksTable:
        """The rows sorted by track, then frame; this table itself where they are."""
        step = np.diff(self.track)
        if ((step > 0) | ((step == 0) & (np.diff(self.frame) > 0))).all():
            return self
        return _rows(self, np.lexsort((self.frame, self.track)))


Table = TypeVar("Table", PointsTable, TracksTable)


def _rows(table: Table, rows: Int64) -> Table:
    """The table with these rows, in this order."""
    return type(table)(**{field.name: getattr(table, field.name)[rows] for field in fields(table)})


def read_points(path: Path) -> PointsTable:
    """Read `points.parquet`, sorted by track.

    Raises:
        InputError: missing, no Parquet, or without the columns that `improvo run` and `improvo label` write.
    """
    return _points(path, read_table(path, points_schema())).in_order()


def read_points_parts(path: Path) -> Iterator[PointsTable]:
    """`points.parquet` a row group at a time, in the order of the file.

    Raises:
        InputError: as `read_points`.
    """
    for part in read_parts(path, points_schema()):
        yield _points(path, part)


def _points(path: Path, table: pa.Table) -> PointsTable:
    names = np.array(table["stability"].to_pylist(), dtype=object)
    codes = np.full(len(names), -1, np.int8)
    for code, name in enumerate(STABILITY_NAMES):
        codes[names == name] = code
    if (codes < 0).any():
        raise InputError(f"{path}: holds a stability other than {', '.join(STABILITY_NAMES)}; write it again")
    return PointsTable(
        table["track"].to_numpy(),
        table["point"].to_numpy(),
        np.stack([table[axis].to_numpy() for axis in "xyz"], axis=1),
        table["observations"].to_numpy().astype(np.int64),
        table["mean_error"].to_numpy(),
        table["max_error"].to_numpy(),
        codes,
        table["segment"].to_numpy().astype(np.int64),
        table["parallax"].to_numpy(),
        table["withheld"].to_numpy().astype(np.bool_),
    )


def read_tracks(path: Path) -> TracksTable:
    """Read `tracks.parquet`, sorted by track, then frame.

    Raises:
        InputError: missing, no Parquet, or without the columns that `improvo run` and `improvo label` write.
    """
    table = read_table(path, tracks_schema())
    return TracksTable(
        table["frame"].to_numpy().astype(np.int64),
        table["track"].to_numpy(),
        np.stack([table["u"].to_numpy(), table["v"].to_numpy()], axis=1),
        table["weight"].to_numpy(),
        table["error"].to_numpy(),
    ).in_order()


@dataclass(frozen=True)
class Observations:
    """Some observations: what of them tells how good the odometry was."""

    frame: Int64  # (M,)
    track: Int64  # (M,)
    error: Float32  # (M,) pixels; NaN where there is none

    @staticmethod
    def joined(parts: Iterable[Observations]) -> Observations:
        """All of them."""
        kept = list(parts)
        nothing = Observations(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.float32))
        names = (field.name for field in fields(Observations))
        return Observations(*(np.concatenate([getattr(part, name) for part in (nothing, *kept)]) for name in names))


def read_observations(path: Path, frames: range | None = None) -> Iterator[Observations]:
    """`tracks.parquet` a row group at a time, in the order of the file.

    Args:
        path: of the table.
        frames: whose observations to read; all if None.

    Raises:
        InputError: as `read_tracks`.
    """
    import pyarrow as pa

    columns = pa.schema([tracks_schema().field(name) for name in ("frame", "track", "error")])
    between = ("frame", frames.start, frames.stop - 1) if frames is not None else None
    for part in read_parts(path, columns, between):
        frame, track, error = (part[name].to_numpy() for name in columns.names)
        rows = slice(None) if frames is None else np.flatnonzero((frame >= frames.start) & (frame < frames.stop))
        yield Observations(frame[rows].astype(np.int64), track[rows], error[rows])
