"""Mode `robust` as a state machine: starting, starting anew, losing and finding the camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from simulated_features import CAMERA, error_percent, hand_motion, nothing_to_see, observe, room

from improvo.odometry.alarms import second_opinion
from improvo.odometry.alarms.second_opinion import SecondOpinion
from improvo.odometry.mapping.initial_pair import InitFailure
from improvo.odometry.modes import robust
from improvo.odometry.modes.states import TrackingState
from improvo.odometry.result.final_view import FinalView
from improvo.odometry.settings import BridgingSettings, OdometrySettings
from improvo.odometry.view import View
from improvo.odometry.visual_odometry import TrackedFrame, VisualOdometry
from improvo.types import Features

TRUTH = hand_motion(110, step=0.03)
INITIALISING, PROVISIONAL = TrackingState.INITIALISING, TrackingState.PROVISIONAL
TRACKING, LOST = TrackingState.TRACKING, TrackingState.LOST


class Run:
    """The odometry over features, with what it said of every frame."""

    def __init__(self, features: list[Features], settings: OdometrySettings | None = None) -> None:
        self.final: list[FinalView] = []
        self.frames: list[TrackedFrame] = []
        self.worlds: list[int] = []
        with VisualOdometry(_no_frontend, CAMERA, settings, on_final=self.final.append) as self.odometry:
            for i, each in enumerate(features):
                self.frames.append(self.odometry.track_features(each, i / 30.0))
                view = self.odometry.newest_view
                assert view is not None
                self.worlds.append(view.world)

    @property
    def states(self) -> list[TrackingState]:
        return [frame.state for frame in self.frames]


def _no_frontend(image: object) -> Features:
    raise AssertionError("the tests hand over features")


def walk(frames: int, dark: tuple[int, ...] = ()) -> list[Features]:
    world = room()
    return [nothing_to_see(i) if i in dark else observe(world, pose, seed=i) for i, pose in enumerate(TRUTH[:frames])]


def contradicts_at(monkeypatch: pytest.MonkeyPatch, *frame_indices: int, stands: bool = False) -> None:
    """The two-view check speaks at these frames, once each, and at no others.

    Args:
        monkeypatch: of the test.
        frame_indices: at which it speaks.
        stands: whether a second map is asked; else it speaks against the first one, too.
    """
    left = set(frame_indices)
    if not stands:
        monkeypatch.setattr(SecondOpinion, "stands", lambda *_: False)

    class Check:
        ambiguous = False
        has_judged = True

        def __init__(self, *_: object) -> None:
            pass

        def start_over(self) -> None:
            pass

        def contradicts(self, view: View, earlier: Mapping[int, View]) -> bool:
            if view.frame_index not in left:
                return False
            left.remove(view.frame_index)
            return True

    monkeypatch.setattr(robust, "TwoViewCheck", Check)


def test_a_map_of_a_long_start_is_checked_before_it_is_trusted() -> None:
    still = [observe(room(), TRUTH[0], seed=1000 + i) for i in range(90)]
    run = Run([*still, *walk(60)])
    start = run.states.index(PROVISIONAL)
    assert start > 90
    assert run.states.index(TRACKING) - start > 10


def test_a_walk_initialises_is_provisional_and_then_tracks() -> None:
    run = Run(walk(100))
    start = run.states.index(PROVISIONAL)
    assert run.states[:start] == [INITIALISING] * start
    confirmed = run.states.index(TRACKING)
    assert 50 <= confirmed - start <= 70
    assert set(run.states[start:confirmed]) == {PROVISIONAL}
    assert set(run.states[confirmed:]) == {TRACKING}
    assert all(frame.cam_from_world is None for frame in run.frames[:start])
    assert all(frame.segment == 0 and frame.inliers > 30 for frame in run.frames[start:])
    assert any(frame.keyframe for frame in run.frames)


def test_a_lost_camera_is_found_again_in_the_same_state() -> None:
    run = Run(walk(100, dark=(40, 41, 90)))
    assert run.states[39:43] == [PROVISIONAL, LOST, LOST, PROVISIONAL]
    assert run.states[89:92] == [TRACKING, LOST, TRACKING]
    assert run.frames[40].segment == -1
    assert len(run.odometry.segments) == 1


def test_too_many_lost_frames_end_the_segment_and_begin_the_next() -> None:
    settings = OdometrySettings(bridging=BridgingSettings(max_frames=0))  # it would find the place again
    run = Run([*walk(50), *(nothing_to_see(i) for i in range(11)), *walk(110)[70:]], settings)
    assert run.states[60] is INITIALISING
    assert set(run.states[50:60]) == {LOST}
    assert run.odometry.segments[0].reason == "lost"
    assert run.odometry.segments[0].last == 49


def test_a_contradicted_provisional_map_starts_anew_over_all_its_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    contradicts_at(monkeypatch, 45)
    run = Run(walk(80))
    trajectory = run.odometry.trajectory
    assert trajectory.valid.all()
    assert len(run.odometry.segments) == 1
    assert error_percent(trajectory.camera_centers, TRUTH[:80, :3, 3]) < 1.0
    assert sorted(view.frame_index for view in run.final) == list(range(80))
    # the next map has the same poses, so the first was right, and it is no alarm
    assert [event.kind for event in run.odometry.events if event.frame_index == 45] == ["checked again"]


def test_a_map_that_starts_anew_with_other_poses_is_an_alarm(monkeypatch: pytest.MonkeyPatch) -> None:
    contradicts_at(monkeypatch, 45)
    monkeypatch.setattr(second_opinion, "same_poses", lambda *_: False)
    run = Run(walk(60))
    assert [event.kind for event in run.odometry.events if event.frame_index == 45] == ["contradiction"]


@pytest.mark.parametrize("frame", [45, 75])
def test_a_contradicted_map_that_a_second_one_agrees_with_stays(monkeypatch: pytest.MonkeyPatch, frame: int) -> None:
    contradicts_at(monkeypatch, frame, stands=True)
    run, usual = Run(walk(110)), Run(walk(110))  # the check speaks once only
    np.testing.assert_array_equal(run.odometry.trajectory.world_from_cam, usual.odometry.trajectory.world_from_cam)
    assert [event.kind for event in run.odometry.events if event.frame_index == frame] == ["checked again"]
    (segment,) = run.odometry.segments
    assert segment.verdict.word == "right"
    assert any("a second map did not" in words for words in segment.verdict.evidence)


def test_a_map_that_starts_anew_is_another_world_in_the_same_segment(monkeypatch: pytest.MonkeyPatch) -> None:
    contradicts_at(monkeypatch, 45)
    run = Run(walk(60))
    posed = [i for i, frame in enumerate(run.frames) if frame.segment == 0]
    assert {run.worlds[i] for i in posed if i < 45} == {1}
    assert {run.worlds[i] for i in posed if i >= 45} == {2}


def test_frames_recovered_before_a_contradiction_are_not_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    contradicts_at(monkeypatch, 45)
    features = walk(80)
    blurred = features[40]
    features[40] = replace(blurred, descriptors=blurred.descriptors[::-1].copy())  # no match is right
    run = Run(features)
    assert sorted(view.frame_index for view in run.final) == list(range(80))


def test_a_map_contradicted_later_ends_its_segment_and_the_next_takes_its_last_frames(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    contradicts_at(monkeypatch, 75)
    run = Run(walk(110))
    first, second = run.odometry.segments
    assert first.reason == "contradicted by two-view geometry"
    assert first.last + 1 == second.first
    assert 75 - second.first < 20
    assert sorted(view.frame_index for view in run.final) == list(range(110))
    assert run.odometry.trajectory.segment.tolist() == [0] * second.first + [1] * (110 - second.first)


def test_each_contradicted_map_of_the_same_frames_speaks_against_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    contradicts_at(monkeypatch, 30, 45)
    assert not any("former map" in words for words in Run(walk(60)).odometry.segments[0].verdict.evidence)
    contradicts_at(monkeypatch, 30, 45)
    monkeypatch.setattr(second_opinion, "same_poses", lambda *_: False)
    twice = Run(walk(60)).odometry.segments[0].verdict.evidence
    words = "each of 2 former maps of these frames was contradicted by two-view geometry"
    assert f"although {words}" in twice
    contradicts_at(monkeypatch, 75)
    first, second = Run(walk(110)).odometry.segments
    assert not any("a former map" in words for words in first.verdict.evidence)
    assert any("a former map" in words for words in second.verdict.evidence)


def test_frames_of_different_segments_have_different_worlds() -> None:
    elsewhere = [observe(room(7), pose, seed=500 + i) for i, pose in enumerate(hand_motion(50, step=0.03, seed=2))]
    run = Run(walk(50) + elsewhere)
    assert len(run.odometry.segments) == 2
    worlds = {frame.segment: run.worlds[i] for i, frame in enumerate(run.frames) if frame.segment >= 0}
    assert worlds[0] != worlds[1]
    assert {frame.segment for frame in run.frames} == {-1, 0, 1}


def test_costly_failures_are_tried_again_ever_more_rarely(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[int] = []

    def failing(buffer: list[View], *_: object) -> InitFailure:
        tried.append(buffer[-1].frame_index)
        return InitFailure("the first views do not fit together", costly=True)

    monkeypatch.setattr(robust, "start_map", failing)
    Run(walk(60))
    assert np.diff(tried).tolist() == [1, 2, 4, 8, 15, 15]


def test_cheap_failures_are_tried_again_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[int] = []

    def failing(buffer: list[View], *_: object) -> InitFailure:
        tried.append(buffer[-1].frame_index)
        return InitFailure("too few matches")

    monkeypatch.setattr(robust, "start_map", failing)
    Run(walk(20))
    assert tried == list(range(1, 20))


def test_the_initialisation_buffer_is_bounded_and_gives_up_its_oldest_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robust, "_MAX_BUFFERED", 5)
    run = Run([observe(room(), TRUTH[0], seed=i) for i in range(20)])  # a still camera
    assert [view.frame_index for view in run.final] == list(range(20))
    assert not run.odometry.trajectory.valid.any()
