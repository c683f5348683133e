"""The recorder of tracks: whenever it writes, every track has the label that it has when all are labelled at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from improvo.backend.simulated import simulated_window
from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.odometry.result.final_view import FinalView
from improvo.odometry.run import track_recorder
from improvo.odometry.run.track_recorder import TrackRecorder
from improvo.stability.rule import label_stability
from improvo.stability.settings import LabelSettings
from improvo.stability.tables import POINTS_FILE, TRACKS_FILE, read_points, read_tracks
from improvo.types import Float64, Tracks

FRAMES = 40


def scene() -> tuple[Tracks, Float64, Float64]:
    """Chains without gaps, some wrong at their end; poses and K."""
    window = simulated_window(seed=0, cameras=FRAMES, points=120, noise=0.3, mean_track=15)
    problem = window.problem
    frame, point = problem.camera_index, problem.point_index
    order = np.lexsort((frame, point))
    frame, point, keypoints = frame[order], point[order], problem.keypoints[order].copy()
    begins = (np.diff(point, prepend=-1) != 0) | (np.diff(frame, prepend=-1) != 1)
    track = np.cumsum(begins) * 3
    keypoints[(track % 4 == 0) & (frame % 5 == 0)] += 9.0
    return (
        Tracks(frame, track, keypoints.astype(np.float32), np.linspace(0.1, 1, len(frame)).astype(np.float32)),
        window.cam_from_world,
        problem.K,
    )


def final_views(tracks: Tracks, cam_from_world: Float64, lost: tuple[int, ...] = ()) -> list[FinalView]:
    views = []
    for frame in range(FRAMES):
        rows = np.flatnonzero(tracks.frame == frame)
        has_pose = frame not in lost
        views.append(
            FinalView(
                frame_index=frame,
                time=frame / 30,
                segment=0 if has_pose else -1,
                world_from_cam=se3.inverse(cam_from_world[frame]) if has_pose else np.full((4, 4), np.nan),
                keypoints=tracks.keypoints[rows].astype(np.float64),
                tracks=tracks.track[rows],
                points=np.where(tracks.track[rows] % 2, tracks.track[rows] // 3, -1),
                weights=tracks.weight[rows].astype(np.float64),
            )
        )
    return views


def record(folder: Path, views: list[FinalView], K: Float64) -> TrackRecorder:
    folder.mkdir()
    camera = Camera(2000, 2000, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    with TrackRecorder(folder, camera, LabelSettings()) as writer:
        for view in views:
            writer.add(view)
    return writer


@pytest.mark.parametrize("flush_every", [1, 3, 7, 1000])
def test_tracks_have_the_labels_that_they_have_all_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flush_every: int
) -> None:
    monkeypatch.setattr(track_recorder, "_FLUSH_EVERY", flush_every)
    tracks, cam_from_world, K = scene()
    lost = (11, 12)
    views = final_views(tracks, cam_from_world, lost)
    order = np.random.default_rng(flush_every).permutation(FRAMES)
    near = sorted(range(FRAMES), key=lambda frame: frame + order[frame] % 4)  # final in nearly the order of frames
    writer = record(tmp_path / "out", [views[frame] for frame in near], K)

    poses, segment = cam_from_world.copy(), np.zeros(FRAMES, np.int64)
    poses[list(lost)], segment[list(lost)] = np.nan, -1
    expected = label_stability(tracks, poses, segment, K)
    points, table = read_points(tmp_path / "out" / POINTS_FILE), read_tracks(tmp_path / "out" / TRACKS_FILE)
    np.testing.assert_array_equal(points.track, expected.track)
    np.testing.assert_array_equal(points.stability, expected.stability)
    np.testing.assert_array_equal(points.observations, expected.observations)
    np.testing.assert_allclose(points.max_error, expected.max_error.astype(np.float32), rtol=1e-5)
    np.testing.assert_array_equal(points.point, np.where(points.track % 2, points.track // 3, -1))
    np.testing.assert_array_equal(table.frame, tracks.frame)
    np.testing.assert_array_equal(table.keypoints, tracks.keypoints)
    np.testing.assert_allclose(table.error, expected.errors.astype(np.float32), rtol=1e-4, atol=1e-5)
    assert (expected.stability == 2).sum() > 10
    assert writer.counts["observations"] == len(tracks)
    assert writer.counts["tracks"] == len(points)
    assert writer.counts["stable"] == (points.stability == 2).sum()


def test_tracks_that_never_end_are_joined_once_a_flush(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A logo or a time stamp is one track of the whole recording, and is carried along to its end."""
    monkeypatch.setattr(track_recorder, "_FLUSH_EVERY", 10)
    joined = []
    join = track_recorder._Rows.joined
    monkeypatch.setattr(track_recorder._Rows, "joined", lambda parts: joined.append(len(parts)) or join(parts))
    rng = np.random.default_rng(0)
    keypoints = rng.uniform(0, 400, (5, 2))
    views = []
    for frame in range(100):
        pose = np.eye(4)
        pose[0, 3] = 0.001 * frame
        short = np.arange(100 + frame - frame % 20, 103 + frame - frame % 20)
        tracks = np.concatenate([np.arange(2), short])
        views.append(FinalView(frame, frame / 30, 0, pose, keypoints, tracks, np.full(5, -1), np.ones(5)))
    late = [*views[:30], *views[31:90], views[30], *views[90:]]  # of frame 31 on nothing is finished for long
    record(tmp_path / "late", late, np.diag([500.0, 500, 1]))
    flushes = len(joined)
    record(tmp_path / "out", views, np.diag([500.0, 500, 1]))
    assert flushes <= 8
    assert joined[flushes:] == [11] * 10 + [1]
    for folder in ("late", "out"):
        points, table = read_points(tmp_path / folder / POINTS_FILE), read_tracks(tmp_path / folder / TRACKS_FILE)
        np.testing.assert_array_equal(points.observations, [100, 100] + [20] * 15)
        np.testing.assert_array_equal(table.frame[:200], np.tile(np.arange(100), 2))
        np.testing.assert_array_equal(table.keypoints[:100], np.tile(keypoints[:1].astype(np.float32), (100, 1)))


def test_a_failure_leaves_no_file(tmp_path: Path) -> None:
    tracks, cam_from_world, K = scene()
    views = final_views(tracks, cam_from_world)

    def broken() -> list[FinalView]:
        yield from views[:20]
        raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        record(tmp_path / "out", broken(), K)
    assert list((tmp_path / "out").iterdir()) == []


def test_a_run_without_any_track_has_empty_tables(tmp_path: Path) -> None:
    nothing = np.zeros(0, np.int64)
    view = FinalView(0, 0.0, -1, np.full((4, 4), np.nan), np.zeros((0, 2)), nothing, nothing, np.zeros(0))
    writer = record(tmp_path / "out", [view], np.eye(3))
    assert len(read_points(tmp_path / "out" / POINTS_FILE)) == 0
    assert len(read_tracks(tmp_path / "out" / TRACKS_FILE)) == 0
    assert writer.counts["tracks"] == 0
