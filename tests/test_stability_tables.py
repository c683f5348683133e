"""The Parquet tables: what is written is read, and nothing is half-written."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from improvo.errors import InputError, OutputError
from improvo.stability import tables
from improvo.stability.rule import IGNORE, STABLE, UNSTABLE, TrackLabels


def some_labels(count: int = 5, first: int = 0) -> TrackLabels:
    rng = np.random.default_rng(0)
    return TrackLabels(
        track=first + np.arange(count) * 3,
        point=np.arange(count) - 1,
        segment=np.zeros(count, np.int64),
        xyz=np.where(np.arange(count)[:, None] == 2, np.nan, rng.normal(size=(count, 3))),
        observations=np.arange(count) + 8,
        mean_error=rng.uniform(0, 3, count),
        max_error=rng.uniform(3, 9, count),
        stability=np.array([IGNORE, UNSTABLE, STABLE] * count, np.int8)[:count],
        parallax_deg=rng.uniform(0, 5, count),
        withheld=np.zeros(count, np.bool_),
        errors=rng.uniform(0, 9, 20),
    )


def test_points_round_trip(tmp_path):
    path, labels = tmp_path / "points.parquet", some_labels()
    with tables.PointsWriter(path) as writer:
        writer.write(labels)
        assert not path.exists()
        writer.write(some_labels(first=100))
    assert writer.rows == 10
    table = tables.read_points(path)
    np.testing.assert_array_equal(table.track, np.concatenate([labels.track, 100 + labels.track]))
    np.testing.assert_array_equal(table.xyz, np.tile(labels.xyz, (2, 1)))
    np.testing.assert_array_equal(table.stability, np.tile(labels.stability, 2))
    np.testing.assert_allclose(table.mean_error, np.tile(labels.mean_error, 2), rtol=1e-6)
    names = pq.read_table(path).column_names
    assert names[:9] == ["track", "point", "x", "y", "z", "observations", "mean_error", "max_error", "stability"]
    assert pq.read_table(path)["stability"].to_pylist()[:3] == ["ignore", "unstable", "stable"]


def test_tracks_round_trip_in_row_groups(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "_ROWS_PER_GROUP", 100)
    path, rng = tmp_path / "tracks.parquet", np.random.default_rng(1)
    frame = np.arange(30)
    keypoints = rng.uniform(0, 600, (30, 2)).astype(np.float32)
    weight, error = rng.uniform(size=30).astype(np.float32), rng.uniform(size=30)
    error[3] = np.nan
    with tables.TracksWriter(path) as writer:
        for track in range(9):
            writer.write(frame, np.full(30, track), keypoints, weight, error)
    assert pq.ParquetFile(path).num_row_groups == 3
    table = tables.read_tracks(path)
    assert len(table) == 270
    np.testing.assert_array_equal(table.keypoints[-30:], keypoints)
    np.testing.assert_array_equal(table.error[:30], error.astype(np.float32))
    assert pq.read_table(path).column_names == ["frame", "track", "u", "v", "weight", "error"]


def test_empty_tables_are_tables(tmp_path):
    with tables.PointsWriter(tmp_path / "points.parquet"), tables.TracksWriter(tmp_path / "tracks.parquet"):
        pass
    assert len(tables.read_points(tmp_path / "points.parquet")) == 0
    assert len(tables.read_tracks(tmp_path / "tracks.parquet")) == 0


def test_same_rows_give_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        with tables.PointsWriter(tmp_path / name) as writer:
            writer.write(some_labels())
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_a_failure_leaves_nothing_behind(tmp_path):
    def fail() -> None:
        with tables.PointsWriter(tmp_path / "points.parquet") as writer:
            writer.write(some_labels())
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_is_one_line(tmp_path):
    (tmp_path / "file").touch()
    path = tmp_path / "file" / "points.parquet"
    with pytest.raises(OutputError, match="cannot be written"), tables.PointsWriter(path):
        pass


def test_bad_files_are_one_line_errors(tmp_path):
    path = tmp_path / "points.parquet"
    with pytest.raises(InputError, match="no such file"):
        tables.read_points(path)
    path.write_bytes(b"PAR1 not really PAR1")
    with pytest.raises(InputError, match="cannot be read as Parquet"):
        tables.read_points(path)
    pq.write_table(pa.table({"track": [1]}), path)
    with pytest.raises(InputError, match="lacks the column"):
        tables.read_points(path)
