"""Mode `paper` does what the paper says, and nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from simulated_features import CAMERA, World, error_percent, hand_motion, nothing_to_see, observe, room

from improvo.geometry import se3
from improvo.odometry.modes import paper
from improvo.odometry.modes.states import TrackingState
from improvo.odometry.result.final_view import FinalView
from improvo.odometry.settings import PAPER, OdometrySettings
from improvo.odometry.view import View
from improvo.odometry.visual_odometry import TrackedFrame, VisualOdometry
from improvo.types import Features, Float64


def _no_frontend(image: object) -> Features:
    raise AssertionError("the tests hand over features")


def tracked(
    features: list[Features], settings: OdometrySettings = PAPER
) -> tuple[VisualOdometry, list[TrackedFrame], list[FinalView]]:
    final: list[FinalView] = []
    with VisualOdometry(_no_frontend, CAMERA, settings, on_final=final.append) as odometry:
        frames = [odometry.track_features(each, i / 30.0) for i, each in enumerate(features)]
    return odometry, frames, final


def relief(seed: int = 0, count: int = 1500) -> World:
    """Points about one unit away, as the paper's initialisation assumes them."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (count, 3)) * (2.0, 1.0, 0.25) + (0.5, 0.0, 1.0)
    descriptors = rng.normal(size=(count, 32))
    return World(points, descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True))


def along_the_relief(frames: int, step: float = 0.01) -> Float64:
    time = np.arange(frames)
    centers = np.stack([step * time, 0.02 * np.sin(time / 8.0), 0.03 * np.sin(time / 11.0)], axis=1)
    turns = np.stack([0.02 * np.sin(time / 9.0), 0.03 * np.sin(time / 13.0), 0.0 * time], axis=1)
    return se3.rigid(se3.so3_exp(turns), centers)


TRUTH = along_the_relief(60)


@pytest.fixture(scope="module")
def seen() -> list[Features]:
    world = relief()
    return [observe(world, pose, seed=i, noise=0.2) for i, pose in enumerate(TRUTH)]


@pytest.fixture(scope="module")
def walked(seen: list[Features]) -> tuple[VisualOdometry, list[TrackedFrame], list[FinalView]]:
    return tracked(seen)


def test_before_a_relief_at_unit_depth_the_trajectory_is_right(
    walked: tuple[VisualOdometry, list[TrackedFrame], list[FinalView]],
) -> None:
    odometry = walked[0]
    assert odometry.trajectory.valid.all()
    assert error_percent(odometry.trajectory.camera_centers, TRUTH[:, :3, 3]) < 3.0
    for found, true in zip(odometry.trajectory.world_from_cam, TRUTH, strict=True):
        assert se3.rotation_angle_deg(found[:3, :3].T @ true[:3, :3]) < 1.0


def test_the_scale_comes_from_the_unit_depths(
    walked: tuple[VisualOdometry, list[TrackedFrame], list[FinalView]],
) -> None:
    path = np.linalg.norm(np.diff(walked[0].trajectory.camera_centers, axis=0), axis=1).sum()
    true = np.linalg.norm(np.diff(TRUTH[:, :3, 3], axis=0), axis=1).sum()
    assert path == pytest.approx(true, rel=0.2)


def test_the_first_points_lie_at_depth_one_on_their_rays(seen: list[Features]) -> None:
    odometry = VisualOdometry(_no_frontend, CAMERA, PAPER)
    first = odometry.track_features(seen[0], 0.0)
    np.testing.assert_array_equal(first.cam_from_world, np.eye(4))
    np.testing.assert_array_equal(odometry.running_points, CAMERA.unproject(seen[0].keypoints.astype(np.float64), 1.0))


def test_a_still_camera_stays_where_it_is(seen: list[Features]) -> None:
    odometry, frames, _ = tracked([seen[0]] * 5)
    for frame in frames:
        np.testing.assert_allclose(frame.cam_from_world, np.eye(4), atol=1e-6)
    assert odometry.trajectory.valid.all()


def test_points_are_the_connect_the_dots_tracks(
    walked: tuple[VisualOdometry, list[TrackedFrame], list[FinalView]],
) -> None:
    point_of_track: dict[int, int] = {}
    for view in walked[2]:
        assert (view.points >= 0).all(), "every keypoint is a point"
        for track, point in zip(view.tracks.tolist(), view.points.tolist(), strict=True):
            assert point_of_track.setdefault(track, point) == point
    assert len(set(point_of_track.values())) == len(point_of_track), "no point has two tracks"


def test_a_frame_is_final_when_thirty_newer_ones_fill_the_window(seen: list[Features]) -> None:
    final: list[int] = []
    odometry = VisualOdometry(_no_frontend, CAMERA, PAPER, on_final=lambda view: final.append(view.frame_index))
    for i, each in enumerate(seen[:40]):
        odometry.track_features(each, i / 30.0)
        assert final == list(range(max(0, i + 1 - 30)))


def test_it_draws_no_random_numbers(
    seen: list[Features], walked: tuple[VisualOdometry, list[TrackedFrame], list[FinalView]]
) -> None:
    again = tracked(seen, replace(PAPER, seed=12345))[0]
    assert again.trajectory.world_from_cam.tobytes() == walked[0].trajectory.world_from_cam.tobytes()


def test_the_depth_regulariser_keeps_the_depths_in_their_range() -> None:
    features = [observe(room(), pose, seed=i) for i, pose in enumerate(hand_motion(30))]
    in_range = {}
    for weight in (1.0, 0.0):
        objective = replace(PAPER.paper_objective, depth_weight=weight)
        odometry, _, final = tracked(features, replace(PAPER, paper_objective=objective))
        xyz = dict(zip(odometry.map.ids.tolist(), odometry.map.xyz, strict=True))
        points = np.array([xyz[point] for point in final[15].points.tolist() if point in xyz])
        depths = se3.transform(se3.inverse(final[15].world_from_cam), points)[:, 2]
        in_range[weight] = ((depths > 0.0) & (depths < 5.5)).mean()
    assert in_range[1.0] > 0.93
    assert in_range[0.0] < in_range[1.0] - 0.03


def test_lost_tracks_end_the_segment_and_the_same_frame_begins_the_next(seen: list[Features]) -> None:
    odometry, frames, _ = tracked([*seen[:20], nothing_to_see(1), nothing_to_see(2), *seen[40:55]])
    assert odometry.trajectory.valid.all()
    assert odometry.trajectory.segment[19:23].tolist() == [0, 1, 2, 3]
    assert [event.frame_index for event in odometry.events if event.kind == "lost"] == [20, 21, 22]
    assert {frame.state for frame in frames} == {TrackingState.TRACKING}


def test_a_segment_of_one_frame_has_no_error(seen: list[Features]) -> None:
    odometry, _, _ = tracked([*seen[:20], nothing_to_see(1), *seen[20:30]])
    assert np.isnan(odometry.segments[1].mean_error)
    assert np.isfinite(odometry.segments[0].mean_error)


def test_evidence_against_one_segment_does_not_count_against_the_next(
    seen: list[Features], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Check:
        """Contradicts once it has seen 15 views."""

        def __init__(self, *_: object) -> None:
            self._seen = 0

        def contradicts(self, view: View, earlier: Mapping[int, View]) -> bool:
            self._seen += 1
            return self._seen >= 15

    monkeypatch.setattr(paper, "TwoViewCheck", Check)
    odometry, _, _ = tracked([*seen[:10], nothing_to_see(1), *seen[10:20]])
    assert len(odometry.segments) == 3
    assert not any(event.kind == "contradiction" for event in odometry.events)
    watched, _, _ = tracked(seen[:16])
    assert [event.frame_index for event in watched.events if event.kind == "contradiction"] == [14, 15]
    assert watched.trajectory.valid.all(), "a contradiction stops nothing"
