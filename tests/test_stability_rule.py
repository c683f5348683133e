"""The stability rule, and whole tracks labelled under known poses."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from improvo.backend.simulated import simulated_window
from improvo.errors import ConfigError
from improvo.stability.rule import IGNORE, STABLE, UNSTABLE, classify, label_stability
from improvo.stability.settings import LabelSettings
from improvo.types import Tracks


def simulated_tracks(noise: float = 0.3, seed: int = 0) -> tuple[Tracks, np.ndarray, np.ndarray, np.ndarray]:
    """Tracks of 10 frames and more under true poses: (tracks, poses, segment, K)."""
    window = simulated_window(seed=seed, cameras=40, points=150, noise=noise, mean_track=25)
    problem = window.problem
    keep = (np.bincount(problem.point_index) >= 10)[problem.point_index]
    tracks = Tracks(
        frame=problem.camera_index[keep],
        track=100 + 2 * problem.point_index[keep],
        keypoints=problem.keypoints[keep].astype(np.float32),
        weight=np.ones(keep.sum(), np.float32),
    )
    assert len(np.unique(tracks.track)) > 50
    return tracks, window.cam_from_world, np.zeros(40, np.int64), problem.K


def moved(tracks: Tracks, track: int, offsets: np.ndarray) -> Tracks:
    """The tracks with one of them shifted in y, frame by frame."""
    keypoints = tracks.keypoints.copy()
    keypoints[tracks.track == track, 1] += offsets
    return Tracks(tracks.frame, tracks.track, keypoints, tracks.weight)


@pytest.mark.parametrize(
    ("observations", "mean_error", "max_error", "expected"),
    [
        (10, 1.0, 9.0, STABLE),  # stable comes first
        (10, 1.01, 5.0, UNSTABLE),
        (10, 1.01, 4.99, IGNORE),
        (9, 0.1, 0.2, IGNORE),
        (9, 50.0, 90.0, IGNORE),
        (30, np.nan, np.nan, IGNORE),
    ],
)
def test_rule_of_the_paper(observations, mean_error, max_error, expected):
    code = classify(np.array([observations]), np.array([mean_error]), np.array([max_error]), LabelSettings())
    assert code.tolist() == [expected]


def test_static_points_are_stable():
    labels = label_stability(*simulated_tracks())
    assert (labels.stability == STABLE).all()
    assert labels.track.tolist() == sorted(set(labels.track.tolist()))
    assert 0.3 < labels.mean_error.mean() < 0.45  # Rayleigh: 0.376
    assert labels.counts()["stable"] == len(labels)


@pytest.mark.parametrize(
    "movement",
    [
        lambda n: np.linspace(0, 15, n),  # slides along an edge
        lambda n: np.where(np.arange(n) < 0.7 * n, 0, 7),  # jumps to a neighbour
        lambda n: 6 * np.sin(np.arange(n)),  # a leaf in the wind
    ],
)
def test_points_that_move_are_unstable_and_alone(movement):
    tracks, *rest = simulated_tracks()
    lengths = {int(track): int((tracks.track == track).sum()) for track in np.unique(tracks.track)}
    longest = max(lengths, key=lambda track: lengths[track])
    labels = label_stability(moved(tracks, longest, movement(lengths[longest])), *rest)
    assert labels.stability[labels.track == longest].tolist() == [UNSTABLE]
    assert (labels.stability[labels.track != longest] == STABLE).all()


def test_any_subset_gives_the_same_labels():
    tracks, *rest = simulated_tracks()
    whole = label_stability(tracks, *rest)
    some = np.isin(tracks.track, whole.track[10:20])
    part = label_stability(
        Tracks(tracks.frame[some], tracks.track[some], tracks.keypoints[some], tracks.weight[some]), *rest
    )
    np.testing.assert_array_equal(part.xyz, whole.xyz[10:20])
    np.testing.assert_array_equal(part.stability, whole.stability[10:20])
    np.testing.assert_array_equal(part.errors, whole.errors[some])


def test_frames_without_a_pose_do_not_count():
    tracks, poses, segment, K = simulated_tracks()
    poses, segment = poses.copy(), segment.copy()
    poses[10:20], segment[10:20] = np.nan, -1
    labels = label_stability(tracks, poses, segment, K)
    lost = (tracks.frame >= 10) & (tracks.frame < 20)
    assert np.isnan(labels.errors[lost]).all()
    in_track = tracks.track == labels.track[5]
    assert labels.observations[5] == (in_track & ~lost).sum()


def test_a_track_over_two_segments_is_judged_in_the_one_that_saw_most_of_it():
    tracks, poses, segment, K = simulated_tracks()
    poses, segment = poses.copy(), segment.copy()
    segment[20:] = 1
    poses[20:, :3, 3] *= 7.0  # another world, another scale
    labels = label_stability(tracks, poses, segment, K)
    for row in range(len(labels)):
        frames = tracks.frame[tracks.track == labels.track[row]]
        early, late = (frames < 20).sum(), (frames >= 20).sum()
        assert labels.segment[row] == (1 if late > early else 0)
        assert labels.observations[row] == max(early, late)
    assert (labels.stability != UNSTABLE).all()


def test_no_pose_at_all():
    tracks, poses, segment, K = simulated_tracks()
    labels = label_stability(tracks, np.full_like(poses, np.nan), np.full_like(segment, -1), K)
    assert (labels.stability == IGNORE).all()
    assert (labels.segment == -1).all()
    assert (labels.observations == 0).all()


def test_no_tracks():
    _, poses, segment, K = simulated_tracks()
    empty = Tracks(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2), np.float32), np.zeros(0, np.float32))
    assert len(label_stability(empty, poses, segment, K)) == 0


@pytest.mark.parametrize("values", [{"min_observations": 1}, {"stable_mean_error": 6.0}, {"loss": "l2"}])
def test_impossible_settings_are_refused(values):
    with pytest.raises(ConfigError):
        LabelSettings(**values)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda tracks, poses, segment, K: (tracks_of(tracks, slice(None, None, -1)), poses, segment, K), "sorted"),
        (lambda tracks, poses, segment, K: (tracks_of(tracks, [0, 0, 1]), poses, segment, K), "each frame once"),
        (lambda tracks, poses, segment, K: (tracks, poses[:3], segment[:3], K), r"outside 0\.\.2 of cam_from_world"),
        (lambda tracks, poses, segment, K: (tracks, poses, segment[:3], K), "segment: shape"),
        (lambda tracks, poses, segment, K: (tracks, poses[:, :3], segment, K), "cam_from_world: shape"),
        (lambda tracks, poses, segment, K: (tracks, poses, segment, K[:2]), "K: shape"),
        (lambda tracks, *rest: (replace(tracks, keypoints=tracks.keypoints[:-1]), *rest), "tracks.keypoints: shape"),
    ],
)
def test_arrays_that_would_give_wrong_labels_are_refused(change: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        label_stability(*change(*simulated_tracks()))


def test_map_points_that_are_not_one_for_each_track_are_refused():
    tracks, *rest = simulated_tracks()
    count = len(np.unique(tracks.track))
    assert label_stability(tracks, *rest, point=np.arange(count)).point.tolist() == list(range(count))
    for wrong in (count - 1, count + 1, len(tracks)):
        with pytest.raises(ValueError, match=rf"point: shape \({wrong},\), expected \({count},\)"):
            label_stability(tracks, *rest, point=np.arange(wrong))


def tracks_of(tracks: Tracks, rows: Any) -> Tracks:
    return Tracks(tracks.frame[rows], tracks.track[rows], tracks.keypoints[rows], tracks.weight[rows])
