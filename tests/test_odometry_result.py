"""What a run leaves: events, segments and their placement, the map's statistics, the trajectory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from simulated_features import CAMERA

from improvo.geometry import se3
from improvo.geometry.alignment import Similarity
from improvo.odometry.mapping.bundle_adjustment import WindowReport
from improvo.odometry.result.events import EventLog
from improvo.odometry.result.final_view import FinalView
from improvo.odometry.result.map_builder import MapBuilder
from improvo.odometry.result.odometry_result import OdometryResult
from improvo.odometry.result.segments import Segment, SegmentPlacement
from improvo.odometry.result.trajectory_builder import TrajectoryBuilder
from improvo.odometry.verdict.verdict import DOUBTFUL, RIGHT, Verdict
from improvo.odometry.view import View
from improvo.types import Float64

POINTS = np.array([[0.0, 0.0, 2.0], [0.2, 0.1, 2.0], [-0.3, 0.2, 4.0]])


def view_at(frame_index: int, x: float = 0.0, seen: tuple[int, ...] = (0, 1), off: float = 0.0) -> View:
    """A view at (x, 0, 0) that observes POINTS `seen`, `off` pixels beside where they are."""
    cam_from_world = se3.rigid(np.eye(3), np.array([-x, 0.0, 0.0]))
    keypoints = CAMERA.project(se3.transform(cam_from_world, POINTS[list(seen)])) + np.array([off, 0.0])
    count = len(seen)
    return View(
        frame_index=frame_index,
        time=frame_index / 10.0,
        keypoints=keypoints,
        descriptors=np.zeros((count, 4), np.float32),
        weights=np.ones(count),
        tracks=np.arange(count),
        points=np.array(seen, np.int64),
        cam_from_world=cam_from_world,
    )


def finalise(result: OdometryResult, *views: View, scale: float = 1.0) -> None:
    for view in views:
        assert view.cam_from_world is not None
        result.finalise(view, view.cam_from_world, scale * POINTS)


def report(mean_error: float) -> WindowReport:
    return WindowReport(mean_error, kept=1, dropped=0, iterations=1)


class TestEvents:
    def test_each_names_its_frame_kind_and_reason(self) -> None:
        log = EventLog()
        log.initialisation_failed(1, "too few matches")
        log.segment_started(2, 0)
        log.lost(5, inliers=3)
        log.contradicted(8, "the segment ends")
        log.segment_started(9, 1)
        log.checked_again(12, "a logo", "has the same poses")
        assert [(event.frame_index, event.kind) for event in log.events] == [
            (1, "initialising"),
            (5, "lost"),
            (8, "contradiction"),
            (9, "segment"),
            (12, "checked again"),
        ]
        assert "a logo" in log.events[4].detail
        assert "the same poses" in log.events[4].detail
        assert "3 points" in log.events[1].detail
        assert "the segment ends" in log.events[2].detail

    def test_the_same_reason_in_a_row_is_said_once_and_again_after_a_start(self) -> None:
        log = EventLog()
        for frame_index in range(3):
            log.initialisation_failed(frame_index, "too few matches")
        log.segment_started(3, 0)
        log.initialisation_failed(4, "too few matches")
        assert [event.frame_index for event in log.events] == [0, 4]

    def test_what_was_told_of_a_segment_is_not_told_again_when_it_is_joined(self) -> None:
        log = EventLog()
        first = Segment(0, 0, 9, 10, 0.5, "lost", Verdict(DOUBTFUL, 9.0, 0.3, ("bad",), ((2, 4),)))
        log.judged(first)
        both = Verdict(DOUBTFUL, 9.0, 0.3, ("bad",), ((2, 4), (22, 25)))
        log.judged(replace(first, last=30, frames=20, verdict=both))
        assert [(event.frame_index, event.kind) for event in log.events] == [
            (2, "uncertain"),
            (9, "doubtful"),
            (22, "uncertain"),
        ]

    def test_a_doubt_that_a_join_takes_away_is_withdrawn(self) -> None:
        log = EventLog()
        first = Segment(0, 0, 9, 10, 0.5, "lost", Verdict(DOUBTFUL, 9.0, 0.3, ("bad",)))
        log.judged(first)
        log.judged(replace(first, last=90, frames=90, verdict=Verdict(RIGHT, 1.0, 0.3, ("bad", "joined"))))
        assert [(event.frame_index, event.kind) for event in log.events] == [(9, "doubtful"), (90, "withdrawn")]
        assert "joined" in log.events[1].detail


class TestPlacement:
    def test_the_first_segment_is_the_shared_world(self) -> None:
        pose = se3.rigid(se3.so3_exp(np.array([0.1, 0.2, 0.3])), np.array([1.0, 2.0, 3.0]))
        np.testing.assert_allclose(SegmentPlacement().place(se3.inverse(pose), np.array([5.0])), pose, atol=1e-12)

    def test_the_next_begins_at_the_last_pose_with_the_last_median_depth(self) -> None:
        placement = SegmentPlacement()
        last = se3.rigid(se3.so3_exp(np.array([0.0, 0.4, 0.0])), np.array([1.0, 0.0, 2.0]))
        placement.place(se3.inverse(last), np.array([3.0, 4.0, 50.0]))
        placement.begin_next()
        np.testing.assert_allclose(placement.place(np.eye(4), np.array([1.0])), last, atol=1e-12)
        ahead = placement.similarity.apply(np.array([[0.0, 0.0, 1.0]]))[0]
        np.testing.assert_allclose(ahead, last[:3, 3] + 4.0 * last[:3, 2])  # depth 1 there is depth 4 here

    def test_a_view_without_points_keeps_the_depth_of_the_one_before(self) -> None:
        placement = SegmentPlacement()
        placement.place(np.eye(4), np.array([3.0]))
        placement.place(np.eye(4), np.zeros(0))
        placement.begin_next()
        assert placement.similarity.scale == 3.0

    def test_points_behind_the_camera_do_not_turn_the_next_segment_inside_out(self) -> None:
        placement = SegmentPlacement()
        placement.place(np.eye(4), np.array([-2.0, -1.0, 3.0]))
        placement.begin_next()
        assert placement.similarity.scale == 3.0
        placement.place(np.eye(4), np.array([-2.0, 0.0]))
        placement.begin_next()
        assert placement.similarity.scale == 3.0


class TestMap:
    def test_mean_and_largest_error_and_count_of_each_point(self) -> None:
        builder = MapBuilder()
        builder.add(np.array([0, 2]), np.array([1.0, 4.0]))
        builder.add(np.array([0]), np.array([3.0]))
        builder.end_segment(POINTS, Similarity(2.0, np.eye(3), np.zeros(3)), number=0)
        found = builder.build()
        assert found.ids.tolist() == [0, 2]  # nobody saw point 1
        assert found.observations.tolist() == [2, 1]
        assert found.mean_error.tolist() == [2.0, 4.0]
        assert found.max_error.tolist() == [3.0, 4.0]
        np.testing.assert_array_equal(found.xyz, 2.0 * POINTS[[0, 2]])

    def test_ids_of_the_next_segment_go_on_after_all_points_of_the_one_before(self) -> None:
        builder, here = MapBuilder(), Similarity(1.0, np.eye(3), np.zeros(3))
        builder.add(np.array([0]), np.array([1.0]))
        builder.end_segment(POINTS, here, number=0)
        builder.add(np.array([1]), np.array([5.0]))
        builder.end_segment(POINTS, here, number=1)
        found = builder.build()
        assert found.ids.tolist() == [0, len(POINTS) + 1]
        assert found.segment.tolist() == [0, 1]
        assert found.mean_error.tolist() == [1.0, 5.0]

    def test_a_copy_lives_on_its_own(self) -> None:
        builder = MapBuilder()
        builder.add(np.array([0]), np.array([1.0]))
        other = builder.copy()
        other.add(np.array([0]), np.array([9.0]))
        other.end_segment(POINTS, Similarity(1.0, np.eye(3), np.zeros(3)), number=0)
        assert len(builder.build()) == 0
        assert other.build().mean_error.tolist() == [5.0]


def test_a_trajectory_is_in_temporal_order_whatever_the_order_of_its_poses() -> None:
    builder = TrajectoryBuilder()
    for frame_index in (2, 0, 1):
        pose = se3.rigid(np.eye(3), np.array([float(frame_index), 0.0, 0.0]))
        builder.add(frame_index, frame_index / 10.0, pose, segment=0)
    builder.add(3, 0.3, np.full((4, 4), np.nan), segment=-1)
    trajectory = builder.build()
    assert trajectory.camera_centers[:3, 0].tolist() == [0.0, 1.0, 2.0]
    assert trajectory.valid.tolist() == [True, True, True, False]
    assert trajectory.segment.tolist() == [0, 0, 0, -1]


class TestResult:
    def test_a_segment_says_its_frames_and_its_mean_window_error(self) -> None:
        result = OdometryResult(CAMERA)
        result.begin_segment()
        for error in (0.5, float("nan"), 1.5):
            result.add_window(report(error))
        finalise(result, view_at(4), view_at(5, x=0.1))
        result.end_segment(POINTS, "lost")
        (segment,) = result.segments
        assert (segment.first, segment.last, segment.frames, segment.reason) == (4, 5, 2, "lost")
        assert segment.mean_error == pytest.approx(1.0)

    @pytest.mark.parametrize("errors", [[], [float("nan")]])
    def test_where_nothing_was_measured_there_is_no_error(self, errors: list[float]) -> None:
        result = OdometryResult(CAMERA)
        result.begin_segment()
        for error in errors:
            result.add_window(report(error))
        finalise(result, view_at(0))
        result.end_segment(POINTS, "end of the sequence")
        assert np.isnan(result.segments[0].mean_error)

    def test_errors_are_those_of_the_final_poses(self) -> None:
        result = OdometryResult(CAMERA)
        finalise(result, view_at(0, off=2.0), view_at(1, x=0.1, off=4.0))
        result.end_segment(POINTS, "")
        np.testing.assert_allclose(result.map.mean_error, [3.0, 3.0])
        np.testing.assert_allclose(result.map.max_error, [4.0, 4.0])

    def test_each_view_is_announced_once_with_the_ids_of_the_whole_map(self) -> None:
        final: list[FinalView] = []
        result = OdometryResult(CAMERA, final.append)
        finalise(result, view_at(0))
        result.end_segment(POINTS, "lost")
        result.give_up([view_at(1)])
        result.begin_segment()
        finalise(result, view_at(2, seen=(2,)))
        result.end_segment(POINTS, "end of the sequence")
        assert [(view.frame_index, view.segment) for view in final] == [(0, 0), (1, -1), (2, 1)]
        assert final[0].points.tolist() == [0, 1]
        assert final[1].points.tolist() == [-1, -1]
        assert final[2].points.tolist() == [len(POINTS) + 2]
        assert np.isnan(final[1].world_from_cam).all()

    def test_a_segment_begun_again_forgets_its_windows(self) -> None:
        result = OdometryResult(CAMERA)
        result.begin_segment()
        result.add_window(report(9.0))
        result.begin_segment()
        result.add_window(report(1.0))
        finalise(result, view_at(0))
        result.end_segment(POINTS, "")
        assert result.segments[0].mean_error == 1.0

    def test_a_segment_without_a_view_leaves_nothing(self) -> None:
        result = OdometryResult(CAMERA)
        result.begin_segment()
        result.end_segment(POINTS, "lost")
        assert result.segments == []
        assert len(result.map) == 0

    def test_a_look_at_the_running_segment_changes_nothing(self) -> None:
        final: list[FinalView] = []
        result = OdometryResult(CAMERA, final.append)
        finalise(result, view_at(0))
        running = view_at(1, x=0.5)
        assert running.cam_from_world is not None
        pose: Float64 = running.cam_from_world
        seen = result.with_running([(running, pose)], [view_at(2)], POINTS)
        assert seen.trajectory.valid.tolist() == [True, True, False]
        assert seen.map.observations.tolist() == [2, 2]
        assert len(final) == 1
        assert len(result.trajectory) == 1
        assert len(result.map) == 0
        assert result.segments == []
