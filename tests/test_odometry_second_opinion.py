"""A second opinion on a contradicted map: a right one stays, a wrong one goes, a dropped one may be cleared."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from simulated_features import CAMERA, hand_motion, observe, room, views_of

from improvo.geometry import se3
from improvo.odometry.alarms import second_opinion
from improvo.odometry.alarms.second_opinion import SecondOpinion, explained_tracks, same_poses
from improvo.odometry.mapping.initial_pair import PLANE_OF_TWO, TWO_MOTIONS, InitFailure
from improvo.odometry.result.events import EventLog
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.view import View
from improvo.types import Float64

FRAMES = 30
TRUTH = hand_motion(FRAMES, step=0.03)
MAX_ERROR = 5.0


def tracked(believed: Float64, true: Float64 = TRUTH) -> list[View]:
    """Views at `true` poses (N, 4, 4 world_from_cam), with tracks, that a map believes to be at `believed`."""
    views = views_of([observe(room(), pose, seed=number) for number, pose in enumerate(true)])
    for view, said in zip(views, believed, strict=True):
        view.cam_from_world = se3.inverse(said)
    return views


def wrong(truth: Float64 = TRUTH) -> Float64:
    """A map that takes half of each step sideways for a turn, as a crowd that moves along makes it."""
    poses = [truth[0]]
    for before, after in pairwise(truth):
        step = se3.inverse(before) @ after
        turned = se3.rigid(se3.so3_exp(np.array([0.0, 0.006, 0.0])), np.zeros(3))
        poses.append(poses[-1] @ step @ turned)
    return np.stack(poses)


def opinion_and_log() -> tuple[SecondOpinion, EventLog]:
    log = EventLog()
    return SecondOpinion(CAMERA, OdometrySettings(), 0.7, log), log


def poses_of(world_from_cam: Float64) -> dict[int, Float64]:
    return dict(enumerate(se3.inverse(world_from_cam)))


def test_a_right_map_stays_and_its_views_are_not_touched() -> None:
    views, (opinion, log) = tracked(TRUTH), opinion_and_log()
    assert opinion.stands(views, "a crowd")
    assert [(event.frame_index, event.kind) for event in log.events] == [(FRAMES - 1, "checked again")]
    assert "a crowd" in log.events[0].detail
    for view, pose in zip(views, TRUTH, strict=True):
        np.testing.assert_array_equal(view.cam_from_world, se3.inverse(pose))
        assert (view.points == -1).all()


def test_a_wrong_map_does_not_stay() -> None:
    opinion, log = opinion_and_log()
    assert not opinion.stands(tracked(wrong()), "two views")
    assert log.events == []


def test_nothing_is_said_for_a_map_where_no_other_can_start() -> None:
    still = np.repeat(TRUTH[:1], FRAMES, axis=0)
    opinion, log = opinion_and_log()
    assert not opinion.stands(tracked(still, still), "two views")
    assert log.events == []


def test_right_poses_explain_the_tracks_and_wrong_ones_fewer() -> None:
    right, off = tracked(TRUTH), tracked(wrong())
    counts = [
        explained_tracks(views, poses_of(poses), CAMERA, 1.5) for views, poses in ((right, TRUTH), (off, wrong()))
    ]
    long = np.unique(np.concatenate([view.tracks for view in right]), return_counts=True)[1] >= 3
    assert counts[0] > 0.9 * long.sum()
    assert counts[1] < 0.8 * counts[0]


def test_attached_keypoints_are_no_tracks_of_the_world() -> None:
    views = tracked(TRUTH)
    for view in views:
        view.attached[:] = True
    assert explained_tracks(views, poses_of(TRUTH), CAMERA, 1.5) == 0


def test_scale_and_world_make_no_other_poses() -> None:
    moved = se3.rigid(se3.so3_exp(np.array([0.4, -0.3, 1.0])), np.array([5.0, 2.0, -1.0])) @ TRUTH
    moved[:, :3, 3] *= 3.0
    assert same_poses(poses_of(TRUTH), poses_of(moved), MAX_ERROR)


def test_another_path_or_turn_makes_other_poses() -> None:
    assert not same_poses(poses_of(TRUTH), poses_of(wrong()), MAX_ERROR)
    off = TRUTH.copy()
    length = np.linalg.norm(np.diff(off[:, :3, 3], axis=0), axis=1).sum()
    off[:, 0, 3] += 0.1 * length * (np.arange(FRAMES) % 2)
    assert not same_poses(poses_of(TRUTH), poses_of(off), MAX_ERROR)


def test_poses_without_common_frames_or_without_a_path_tell_nothing() -> None:
    later = {frame + FRAMES: pose for frame, pose in poses_of(TRUTH).items()}
    assert not same_poses(poses_of(TRUTH), later, MAX_ERROR)
    still = poses_of(np.repeat(TRUTH[:1], FRAMES, axis=0))
    assert not same_poses(still, still, MAX_ERROR)
    turning = TRUTH.copy()
    turning[:, :3, 3] = 0.0
    assert not same_poses(poses_of(turning), poses_of(TRUTH), MAX_ERROR)
    assert not same_poses(poses_of(TRUTH), poses_of(turning), MAX_ERROR)


@pytest.mark.parametrize("poses_contradicted", [True, False])
@pytest.mark.parametrize("former", [TRUTH, wrong()])
def test_a_dropped_map_is_cleared_if_the_next_has_its_poses(former: Float64, *, poses_contradicted: bool) -> None:
    kind = "checked again" if former is TRUTH else "contradiction"
    opinion, log = opinion_and_log()
    opinion.drop(tracked(former), "a logo", poses_contradicted=poses_contradicted)
    assert log.events == [], "it is told once the next map has started"
    cleared = opinion.on_dropped(tracked(TRUTH))
    assert not opinion.on_dropped(tracked(TRUTH))
    assert cleared == (kind == "checked again")
    assert [(event.frame_index, event.kind) for event in log.events] == [(FRAMES - 1, kind)]


def test_a_map_whose_poses_nothing_contradicted_is_cleared_by_the_tracks() -> None:
    """The next map is worse. Two views that contradicted the first may have been right all the same."""
    for poses_contradicted in (False, True):
        opinion, log = opinion_and_log()
        opinion.drop(tracked(TRUTH), "a logo", poses_contradicted=poses_contradicted)
        assert opinion.on_dropped(tracked(wrong())) == (not poses_contradicted)
        assert log.events[0].kind == ("contradiction" if poses_contradicted else "checked again")


def test_a_dropped_map_that_nothing_follows_was_contradicted() -> None:
    opinion, log = opinion_and_log()
    opinion.drop(tracked(TRUTH), "a logo", poses_contradicted=False)
    assert not opinion.on_dropped([])
    assert [event.kind for event in log.events] == ["contradiction"]


@pytest.mark.parametrize(("reason", "stays"), [(TWO_MOTIONS, True), (PLANE_OF_TWO, True), ("too few matches", False)])
def test_two_views_with_two_motions_give_up_no_map(
    monkeypatch: pytest.MonkeyPatch, reason: str, *, stays: bool
) -> None:
    monkeypatch.setattr(second_opinion, "start_map", lambda *_: InitFailure(reason))
    opinion, log = opinion_and_log()
    assert opinion.stands(tracked(TRUTH), "two views") == opinion.undecided == stays
    assert [event.kind for event in log.events] == ["checked again"] * stays
