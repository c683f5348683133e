"""A camera that was lost and comes back: one world again, or two where it is another place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from simulated_features import CAMERA, World, error_percent, hand_motion, nothing_to_see, observe, room

from improvo.geometry import se3
from improvo.geometry.a_contrario import disc_probability, log10_false_alarms
from improvo.geometry.alignment import Similarity
from improvo.odometry.mapping.bridging import Bridging, Join
from improvo.odometry.mapping.camera_path import CameraPath
from improvo.odometry.mapping.former_map import Sighting
from improvo.odometry.modes.states import TrackingState
from improvo.odometry.result.odometry_result import OdometryResult
from improvo.odometry.settings import BridgingSettings, OdometrySettings
from improvo.odometry.view import View
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
    def path(first: int, start: float, x: float) -> CameraPath:
        steps = np.arange(5.0)
        return CameraPath(
            np.stack([first + steps, start + 0.1 * steps], axis=1), np.outer(x + 0.4 * steps, [1.0, 0.0, 0.0])
        )

    before = path(6, 0.6, -1.6)  # ends with frame 10, after a second, at zero
    assert path(frame, seconds, place).is_leap_from(before, slack=0.5) == leaps


def test_a_path_in_another_world() -> None:
    path = CameraPath(np.array([[0.0, 0.0], [2.0, 0.2]]), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    np.testing.assert_allclose(path.fastest, [0.5, 5.0])
    np.testing.assert_allclose(path.placed(Similarity(3.0, np.eye(3), np.ones(3))).centers, [[1, 1, 1], [4, 1, 1]])
    alone = CameraPath(np.zeros((1, 2)), np.zeros((1, 3)))
    np.testing.assert_array_equal(alone.fastest, [0.0, 0.0])
    nothing = CameraPath(np.zeros((0, 2)), np.zeros((0, 3)))
    assert not nothing.is_leap_from(path, 0.0)
    assert not path.is_leap_from(nothing, 0.0)


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


class ScriptedMap:
    """A former map at the origin, in which each view is found with the next scale of a list; at depth 2."""

    number, last_frame = 0, 50
    shared_from_own = Similarity(1.0, np.eye(3), np.zeros(3))

    def __init__(self, scales: list[float | None]) -> None:
        self._scales = iter(scales)
        self.camera_path = CameraPath(
            np.array([[49.0, 1.63], [50.0, 1.66]]), np.array([[-0.05, 0.0, 0.0], [0.0, 0.0, 0.0]])
        )

    def sighting(self, view: View, xyz: Float64) -> Sighting | None:
        scale = next(self._scales)
        if scale is None:
            return None
        assert view.cam_from_world is not None
        former_pose = np.eye(4)
        former_pose[0, 3] = 0.01 * (view.frame_index - 50)
        center = se3.inverse(view.cam_from_world)[:3, 3]
        placed = Similarity(scale, np.eye(3), former_pose[:3, 3] - scale * center)
        return Sighting(view.frame_index, placed, 0.005, center, former_pose, depth=2.0, inliers=80)


def joins_of(scales: list[float | None]) -> list[Join | None]:
    """What a new map's keyframes find, six frames apart, where it moves by 0.01 a frame in the former map."""
    bridging, running, found = Bridging(OdometrySettings()), [], []
    bridging.remember(ScriptedMap(scales))
    for i, scale in enumerate(scales):
        pose = np.eye(4)
        pose[0, 3] = -0.06 * i / (scale or 1.0)
        empty = (
            np.zeros((0, 2)),
            np.zeros((0, 1), np.float32),
            np.zeros(0),
            np.zeros(0, np.int64),
            np.zeros(0, np.int64),
        )
        view = View(60 + 6 * i, (60 + 6 * i) / 30.0, *empty, cam_from_world=pose, keyframe=True)
        running.append(view)
        found.append(bridging.look(view, np.zeros((0, 3)), running))
    return found


def test_a_join_takes_the_scale_of_the_newest_sightings_since_a_young_map_changes_its_own() -> None:
    joins = joins_of([2.5, 2.4, 1.9, 1.6, 1.5, 1.48])
    assert joins[0] is None
    scales = [join.shared_from_new.scale for join in joins if join is not None]
    assert scales[0] == pytest.approx(np.sqrt(2.5 * 2.4))
    assert scales[-1] == pytest.approx(np.sqrt(1.5 * 1.48))
    assert joins[-1] is not None
    assert joins[-1].scale_error < 0.02


def test_a_join_that_the_newest_sighting_contradicts_is_known_no_better_than_that() -> None:
    joins = joins_of([2.5, 2.45, 2.48, 1.4])
    first, last = joins[2], joins[3]
    assert first is not None
    assert last is not None
    assert last.shared_from_new == first.shared_from_new
    assert last.scale_error == pytest.approx(np.log(2.465 / 1.4), abs=0.03)  # which makes the segment doubtful


def test_a_join_stays_where_the_former_map_is_not_seen_any_more() -> None:
    assert [join is not None for join in joins_of([2.5, 2.45, None, None])] == [False, True, False, False]


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
