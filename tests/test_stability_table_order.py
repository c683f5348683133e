"""Tables are written in groups while tracks end; whoever reads them gets the rows sorted, however they were written."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rendered_walk import write_walk

from improvo.cli.main import main
from improvo.export.model import segment_model
from improvo.odometry.run.run_folder import RunFolder
from improvo.stability.rule import IGNORE
from improvo.stability.tables import POINTS_FILE, TRACKS_FILE, read_points, read_tracks
from labeled_scene import write_labeled_scene


def as_written(path: Path) -> pa.Table:
    return pq.read_table(path)


def reverse_tracks(folder: Path) -> None:
    """Write the tables of a folder again with the tracks in reverse, each one's rows still in the order of frames."""
    for name in (TRACKS_FILE, POINTS_FILE):
        table = as_written(folder / name)
        track = table["track"].to_numpy()
        frame = table["frame"].to_numpy() if name == TRACKS_FILE else track
        pq.write_table(table.take(pa.array(np.lexsort((frame, -track)))), folder / name)


def test_a_long_run_writes_its_tracks_in_groups_and_readers_sort_them(long_run: Path) -> None:
    assert json.loads((long_run / "run.json").read_text())["frames"]["tracked"] > 220
    stored, tracks = as_written(long_run / TRACKS_FILE), read_tracks(long_run / TRACKS_FILE)
    assert (np.diff(stored["track"].to_numpy()) < 0).any(), "the test needs a file that is not sorted"
    assert len(tracks) == stored.num_rows
    assert (np.diff(tracks.track) >= 0).all()
    assert (np.diff(tracks.frame)[np.diff(tracks.track) == 0] > 0).all()
    rows = np.lexsort((stored["frame"].to_numpy(), stored["track"].to_numpy()))
    np.testing.assert_array_equal(tracks.keypoints[:, 0], stored["u"].to_numpy()[rows])
    np.testing.assert_array_equal(tracks.error, stored["error"].to_numpy()[rows])
    points = read_points(long_run / POINTS_FILE)
    np.testing.assert_array_equal(points.track, np.unique(tracks.track))


def test_tables_in_order_are_not_copied(long_run: Path) -> None:
    tracks, points = read_tracks(long_run / TRACKS_FILE), read_points(long_run / POINTS_FILE)
    assert tracks.in_order() is tracks
    assert points.in_order() is points


def test_a_long_run_finds_every_track_again(long_run: Path) -> None:
    run = RunFolder(long_run)
    table, points = run.tracks, run.points
    label_of = dict(zip(points.track.tolist(), points.stability.tolist(), strict=True))
    first = {track: int(table.frame[table.track == track].min()) for track in np.unique(table.track).tolist()}
    for position in (5, 120, 201, 226):
        seen = run.observations(position)
        before = set(table.track[table.frame == position - 1].tolist())
        continuing = np.isin(seen.track, list(before))
        assert continuing.sum() > 30
        np.testing.assert_array_equal(run.rows_of(position - 1, seen.track) >= 0, continuing)
        assert seen.age.tolist() == [position - first[track] for track in seen.track.tolist()]
        assert seen.stability.tolist() == [label_of[track] for track in seen.track.tolist()]


def test_an_export_of_a_long_run_has_every_point_with_its_observations(long_run: Path, tmp_path: Path) -> None:
    model = segment_model(RunFolder(long_run), 0)
    assert np.bincount(model.point, minlength=len(model.xyz)).min() >= 3
    assert len(set(zip(model.point.tolist(), model.frame.tolist(), strict=True))) == len(model.point)
    opened_by_pycolmap(long_run, tmp_path)


def opened_by_pycolmap(run: Path, folder: Path) -> None:
    """Export a run, open it with pycolmap, and compare."""
    pycolmap = pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'improvo[dev]'")
    assert main(["export", "colmap", str(run), "-o", str(folder / "colmap"), "--no-images"]) == 0
    model = segment_model(RunFolder(run), 0)
    opened = pycolmap.Reconstruction(str(folder / "colmap" / "sparse" / "0"))
    assert opened.num_points3D() == len(model.xyz) > 100
    assert opened.compute_num_observations() == len(model.error)
    assert all(point.track.length() >= 3 for point in opened.points3D.values())
    opened.update_point_3d_errors()
    assert opened.compute_mean_reprojection_error() == pytest.approx(model.mean_error, abs=1e-6)


def test_pycolmap_opens_a_real_run_of_more_than_two_hundred_frames(shared_data: Path, tmp_path: Path) -> None:
    words = ["--frontend", "orb", "--max-keypoints", "400", "--width", "320", "--max-frames", "240"]
    assert main(["run", str(shared_data / "redkitchen"), "-o", str(tmp_path / "run"), *words]) == 0
    assert (np.diff(as_written(tmp_path / "run" / TRACKS_FILE)["track"].to_numpy()) < 0).any()
    opened_by_pycolmap(tmp_path / "run", tmp_path)


def pictures(folder: Path) -> list[Any]:
    from improvo.report.track_pictures import paint_labels, paint_residuals, paint_tracks

    run = RunFolder(folder)
    return [paint(run, 20) for paint in (paint_labels, paint_residuals, paint_tracks)]


def page(folder: Path) -> list[Any]:
    from improvo.report.page_data import _packed_points, per_frame

    run = RunFolder(folder)
    tracks = per_frame(run, lambda rows: float((run.tracks.frame[rows] > run.birth[rows]).sum()))
    return [tracks, _packed_points(run, 20, 30, 3.0)]


def model(folder: Path) -> list[Any]:
    exported = segment_model(RunFolder(folder), 0)
    return [exported.xyz, exported.frame, exported.point, exported.keypoints, exported.error, exported.stability]


@pytest.mark.parametrize("read", [pictures, page, model])
def test_the_order_of_rows_changes_nothing_of_a_run(
    finished_run: Path, tmp_path: Path, read: Callable[[Path], list[Any]]
) -> None:
    shutil.copytree(finished_run, tmp_path / "run")
    reverse_tracks(tmp_path / "run")
    for expected, found in zip(read(finished_run), read(tmp_path / "run"), strict=True):
        np.testing.assert_array_equal(expected, found)


def test_the_order_of_rows_changes_nothing_that_is_trained_on(tmp_path: Path) -> None:
    from improvo.labeling.labeled import read_labels
    from improvo.training.data.labeled_frames import LabeledFrames
    from improvo.training.data.wrong_links import largest_step_shares
    from improvo.training.settings import LandmarkSettings

    stores = [write_labeled_scene(tmp_path / name, wrong_link=True) for name in ("as-written", "reversed")]
    reverse_tracks(stores[1] / "walls")
    (expected,), (found,) = (read_labels(store) for store in stores)
    np.testing.assert_array_equal(largest_step_shares(expected), largest_step_shares(found))
    frames = [LabeledFrames(sequence, 160, LandmarkSettings()) for sequence in (expected, found)]
    for frame in (0, 7, 30):
        points = [each.points(frame) for each in frames]
        for name in ("points", "landmark", "stability", "seen"):
            np.testing.assert_array_equal(*(getattr(each, name) for each in points))


def test_the_order_of_rows_changes_no_judgement_of_labels(tmp_path: Path) -> None:
    from improvo.evaluation.stability.protocol import median_errors

    walk = write_walk(tmp_path / "walk", frames=16)
    out = tmp_path / "labels"
    words = ["--frontend", "orb", "--max-keypoints", "500", "--set", "labels.min_observations=6"]
    assert main(["label", str(walk), "-o", str(out), *words]) == 0
    before = [read_tracks(out / "walk" / TRACKS_FILE), read_points(out / "walk" / POINTS_FILE)]
    reverse_tracks(out / "walk")
    after = [read_tracks(out / "walk" / TRACKS_FILE), read_points(out / "walk" / POINTS_FILE)]
    for table, other in zip(before, after, strict=True):
        for name in type(table).__dataclass_fields__:
            np.testing.assert_array_equal(getattr(table, name), getattr(other, name))
    medians = [
        median_errors(tracks.track, tracks.error, points.track[points.stability != IGNORE])
        for tracks, points in (before, after)
    ]
    assert len(medians[0]) > 20
    np.testing.assert_array_equal(*medians)
