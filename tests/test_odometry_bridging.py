"""A camera that was lost and comes back: one world again, or two where it is another place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from simulated_features import CAMERA, World, error_percent, hand_motion, nothing_to_see, observe, room

from improvo.geometry import se3
from improvo.geometry.a_contrario import disc_probability, log10_false_alarms
from improvo.geometry.alignment import Similarity
from improvo.odometry.mapping.course import Course
from improvo.odometry.result import OdometryResult
from improvo.odometry.settings import BridgingSettings, OdometrySettings
from improvo.odometry.states import TrackingState
from improvo.odometry.visual_odometry import VisualOdometry
from improvo.types import Features, Float64, Mask

TRUTH = hand_motion(150, step=0.03)
GAP = 12  # frames; more than the odometry waits for


def run(features: list[Features], settings: OdometrySettings | None = None) -> VisualOdometry:
    with VisualOdometry(lambda image: pytest.fail("no pictures here"), CAMERA, settings) as odometry:
        for i, each in enumerate(features):
            odometry.track_features(each, i / 30.0)
    return odometry


def with_a_gap(back: int) -> tuple[list[Features], list[int]]:
    """Fifty frames, a gap, and fifty more from frame `back` on; and the true frame of each, -1 in the gap."""
    frames = [*range(50), *([-1] * GAP), *range(back, back + 50)]
    world = room()
    return [nothing_to_see(i) if f < 0 else observe(world, TRUTH[f], seed=i) for i, f in enumerate(frames)], frames


def test_a_camera_that_comes_back_goes_on_in_the_same_world_and_scale() -> None:
    features, frames = with_a_gap(back=40)
    odometry = run(features)
    assert len(odometry.segments) == 1
    segment = odometry.segments[0]
    assert (segment.first, segment.last) == (0, len(features) - 1)
    assert segment.frames == 100
    trajectory = odometry.trajectory
    posed = trajectory.valid
    truth = TRUTH[[frame for frame, has_pose in zip(frames, posed, strict=True) if has_pose], :3, 3]
    assert error_percent(trajectory.camera_centers[posed], truth) < 1.0
    bridged = [event for event in odometry.events if event.kind == "bridged"]
    assert len(bridged) == 1
    assert "segment 0" in bridged[0].detail
    assert segment.verdict.word == "right"
    assert any("joined" in words for words in segment.verdict.evidence)
    assert set(odometry.map.segment.tolist()) == {0}


@pytest.mark.parametrize(("metres", "segments"), [(1.0, [(0, 111)]), (2.5, [(0, 49), (62, 111)])])
def test_a_place_that_cannot_be_reached_within_the_gap_only_looks_the_same(
    metres: float, segments: list[tuple[int, int]]
) -> None:
    features, _ = with_a_gap(back=40)
    ahead = TRUTH[40:90].copy()
    ahead[:, 2, 3] += metres  # within thirteen frames, of which each had at most 0.04 m
    odometry = run([*features[: 50 + GAP], *(observe(room(), pose, seed=100 + i) for i, pose in enumerate(ahead))])
    assert [(each.first, each.last) for each in odometry.segments] == segments
    assert all(segment.verdict.word == "right" for segment in odometry.segments)


@pytest.mark.parametrize(
    ("frame", "seconds", "place", "leaps"),
    [
        (12, 1.2, 2.9, False),  # less than three times as fast over two frames
        (12, 1.2, 6.4, True),
        (12, 5.0, 6.4, False),  # frames were left out: four seconds are long enough
        (50, 1.2, 6.4, False),  # times are wrong: forty frames are enough
        (12, 0.5, 2.9, False),  # times that go back say nothing
        (10, 1.0, 0.9, True),
    ],
)
def test_what_a_camera_can_reach(frame: int, seconds: float, place: float, leaps: bool) -> None:
    def course(first: int, start: float, x: float) -> Course:
        steps = np.arange(5.0)
        return Course(
            np.stack([first + steps, start + 0.1 * steps], axis=1), np.outer(x + 0.4 * steps, [1.0, 0.0, 0.0])
        )

    before = course(6, 0.6, -1.6)  # ends with frame 10, after a second, at zero
    assert course(frame, seconds, place).is_leap_from(before, slack=0.5) == leaps


def test_a_course_in_another_world() -> None:
    course = Course(np.array([[0.0, 0.0], [2.0, 0.2]]), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    np.testing.assert_allclose(course.fastest, [0.5, 5.0])
    np.testing.assert_allclose(course.placed(Similarity(3.0, np.eye(3), np.ones(3))).centers, [[1, 1, 1], [4, 1, 1]])
    alone = Course(np.zeros((1, 2)), np.zeros((1, 3)))
    np.testing.assert_array_equal(alone.fastest, [0.0, 0.0])
    nothing = Course(np.zeros((0, 2)), np.zeros((0, 3)))
    assert not nothing.is_leap_from(course, 0.0)
    assert not course.is_leap_from(nothing, 0.0)


def test_without_bridging_it_begins_another_segment() -> None:
    features, _ = with_a_gap(back=40)
    odometry = run(features, replace(OdometrySettings(), bridging=BridgingSettings(max_frames=0)))
    assert len(odometry.segments) == 2
    assert not any(event.kind == "bridged" for event in odometry.events)


def test_another_place_is_another_segment() -> None:
    features, _ = with_a_gap(back=40)
    other = [observe(room(9), pose, seed=700 + i) for i, pose in enumerate(hand_motion(50, step=0.03, seed=3))]
    odometry = run([*features[: 50 + GAP], *other])
    assert len(odometry.segments) == 2
    assert odometry.segments[0].verdict.word == odometry.segments[1].verdict.word == "right"


@pytest.mark.parametrize(("alike", "segments"), [(25, 2), (120, 1)])
def test_a_place_that_looks_alike_in_a_few_points_is_another_segment(alike: int, segments: int) -> None:
    features, frames = with_a_gap(back=40)
    seen = np.flatnonzero(_in_picture(room(), TRUTH[frames[50 + GAP :]]))[:alike]
    here, there = room(), room(9)
    mixed = World(
        np.concatenate([here.points[seen], there.points]), np.concatenate([here.descriptors[seen], there.descriptors])
    )
    elsewhere = [observe(mixed, TRUTH[f], seed=700 + i) for i, f in enumerate(frames[50 + GAP :])]
    assert len(run([*features[: 50 + GAP], *elsewhere]).segments) == segments


def _in_picture(world: World, world_from_cam: Float64) -> Mask:
    """(P,) points of a world that all of these views (N, 4, 4) show."""
    shown = np.ones(len(world.points), bool)
    for pose in world_from_cam:
        points_cam = se3.transform(se3.inverse(pose), world.points)
        pixels = CAMERA.project(points_cam)
        shown &= (points_cam[:, 2] > 0.1) & (pixels > 0).all(axis=1) & (pixels < (CAMERA.width, CAMERA.height)).all(1)
    return shown


def test_the_state_is_provisional_until_the_joined_map_is_confirmed() -> None:
    features, _ = with_a_gap(back=40)
    with VisualOdometry(lambda image: pytest.fail("no pictures here"), CAMERA) as odometry:
        tracked = [odometry.track_features(each, i / 30.0) for i, each in enumerate(features)]
    after = [frame for frame in tracked if frame.frame_index >= 50 + GAP and frame.cam_from_world is not None]
    assert {frame.state for frame in after} == {TrackingState.PROVISIONAL}
    assert after[-1].segment == 0


def test_two_runs_that_join_give_the_same_bytes() -> None:
    features, _ = with_a_gap(back=40)
    a, b = run(features), run(features)
    assert a.trajectory.world_from_cam.tobytes() == b.trajectory.world_from_cam.tobytes()
    assert [segment.verdict for segment in a.segments] == [segment.verdict for segment in b.segments]


def test_a_segment_with_final_views_is_not_joined() -> None:
    result = OdometryResult(CAMERA)
    result._frame_indices.append(0)
    with pytest.raises(RuntimeError, match="final views"):
        result.join(0, result.placement, 0.01)


def pose_by_chance(inliers: int, matches: int, threshold: float) -> float:
    chance = disc_probability(CAMERA.width, CAMERA.height, threshold)
    return log10_false_alarms(matches, inliers, chance, sample=3, models=4)


class TestSignificance:
    def test_what_chance_gives_is_no_pose(self) -> None:
        assert pose_by_chance(5, 100, 3.0) > -1.0
        assert pose_by_chance(3, 3, 3.0) == np.inf

    def test_more_inliers_mean_more_and_more_matches_or_a_wider_threshold_less(self) -> None:
        base = pose_by_chance(15, 100, 3.0)
        assert base < -6.0
        assert pose_by_chance(20, 100, 3.0) < base
        assert pose_by_chance(15, 300, 3.0) > base
        assert pose_by_chance(15, 100, 6.0) > base
