"""The map around the camera: pose of a view, search by projection, new points."""

from __future__ import annotations

import numpy as np
import pytest
from simulated_features import CAMERA, hand_motion, nothing_to_see, observe, room, views_of

from improvo.geometry import se3
from improvo.odometry.gates import MEMORY_FRAMES
from improvo.odometry.mapping import local_map as local_map_module
from improvo.odometry.mapping.local_map import LocalMap
from improvo.odometry.mapping.start import start_map
from improvo.odometry.result.events import EventLog
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.view import View

FRAMES = 26
TRUTH = hand_motion(FRAMES, step=0.05)


@pytest.fixture
def mapped() -> tuple[LocalMap, list[View]]:
    """A map of the first 20 views, and all views; the last six have tracks but no pose."""
    world = room()
    views = views_of([observe(world, pose, seed=i) for i, pose in enumerate(TRUTH)])
    local_map = start_map(views[:20], CAMERA, OdometrySettings(), descriptor_distance=0.7)
    assert isinstance(local_map, LocalMap)
    return local_map, views


def turned(view: View, expected_index: int, reference: View) -> float:
    """Degrees between the relative rotation that was found and the true one."""
    assert view.cam_from_world is not None
    assert reference.cam_from_world is not None
    found = view.cam_from_world[:3, :3] @ reference.cam_from_world[:3, :3].T
    true = TRUTH[expected_index, :3, :3].T @ TRUTH[reference.frame_index, :3, :3]
    return float(se3.rotation_angle_deg(found.T @ true))


def test_a_view_is_localised_from_the_tracks_of_its_neighbour(mapped: tuple[LocalMap, list[View]]) -> None:
    local_map, views = mapped
    inliers, share = local_map.localise(views[20], views[19])
    assert inliers > 50
    assert share > 0.9
    assert turned(views[20], 20, views[0]) < 0.5


def test_search_by_projection_finds_points_that_no_track_leads_to(mapped: tuple[LocalMap, list[View]]) -> None:
    local_map, views = mapped
    inliers, _ = local_map.localise(views[20], views[19])
    found = len(views[20].observed) - inliers
    assert found > 10, "a third of the points is missed in each frame, and most are back in a later one"
    pixels, visible = local_map.project(
        views[20].cam_from_world, local_map.store.xyz[views[20].points[views[20].observed]]
    )
    assert visible.all()
    assert np.linalg.norm(pixels - views[20].keypoints[views[20].observed], axis=1).max() < 8.0


def test_no_point_is_observed_twice_in_a_view(mapped: tuple[LocalMap, list[View]]) -> None:
    local_map, views = mapped
    local_map.localise(views[20], views[19])
    points = views[20].points[views[20].observed]
    assert len(np.unique(points)) == len(points)


def test_without_common_tracks_earlier_views_are_matched_by_descriptors(mapped: tuple[LocalMap, list[View]]) -> None:
    local_map, views = mapped
    far = views[25]
    far.tracks = far.tracks + 10**6  # nothing leads to it
    inliers, _ = local_map.localise(far, views[19])
    assert inliers > 30
    assert turned(far, 25, views[0]) < 0.5


def test_a_place_that_the_camera_cannot_have_come_to_is_refused_and_says_so(
    mapped: tuple[LocalMap, list[View]], monkeypatch: pytest.MonkeyPatch
) -> None:
    local_map, views = mapped
    monkeypatch.setattr(local_map_module, "_FASTER", 0.1)
    monkeypatch.setattr(local_map_module, "_FAST", 0.0)
    far = views[25]
    far.tracks = far.tracks + 10**6
    inliers, _ = local_map.localise(far, views[19])
    assert far.cam_from_world is None
    assert local_map.refused > 30
    events = EventLog()
    events.lost(25, inliers, local_map.refused)
    assert f"{local_map.refused} points of the map found, but where the camera can" in events.events[0].detail
    dark = views_of([nothing_to_see(3)], first=20)[0]
    local_map.localise(dark, views[19])
    assert local_map.refused == 0


def test_a_view_that_shows_nothing_of_the_map_gets_no_pose(mapped: tuple[LocalMap, list[View]]) -> None:
    local_map, views = mapped
    dark = views_of([nothing_to_see(3)], first=20)[0]
    inliers, _ = local_map.localise(dark, views[19])
    assert inliers < 12
    assert dark.cam_from_world is None
    assert (dark.points == -1).all()


def test_doubtful_points_that_fit_the_pose_stay_though_no_sample_holds_them(
    mapped: tuple[LocalMap, list[View]],
) -> None:
    local_map, views = mapped
    views[20].weights = np.where(np.arange(len(views[20])) % 2, 0.9, 0.1)
    local_map.localise(views[20], views[19])
    observed = views[20].observed
    assert (views[20].weights[observed] < 0.5).mean() > 0.3


def test_new_points_lie_where_their_tracks_were_seen(mapped: tuple[LocalMap, list[View]]) -> None:
    local_map, views = mapped
    for view, before in zip(views[20:], views[19:], strict=False):
        local_map.localise(view, before)
    count = local_map.store.count
    made = local_map.triangulate(views[25], views[15:25])
    assert made > 5
    assert local_map.store.count == count + made
    for view in views[15:]:
        rows = np.flatnonzero(view.points >= count)
        pixels, visible = local_map.project(view.cam_from_world, local_map.store.xyz[view.points[rows]])
        assert visible.all()
        assert np.linalg.norm(pixels - view.keypoints[rows], axis=1).max(initial=0.0) <= 3.0


def test_a_point_belongs_to_the_keypoints_of_its_track(mapped: tuple[LocalMap, list[View]]) -> None:
    local_map, views = mapped
    local_map.localise(views[20], views[19])
    count = local_map.store.count
    local_map.triangulate(views[20], views[10:20])
    track_of: dict[int, int] = {}
    for view in views[10:21]:
        for row in np.flatnonzero(view.points >= count):
            assert track_of.setdefault(int(view.points[row]), int(view.tracks[row])) == view.tracks[row]


def test_points_not_seen_for_long_are_not_searched_for(monkeypatch: pytest.MonkeyPatch) -> None:
    world = room()
    observed = []
    for frames in (MEMORY_FRAMES, 1):
        monkeypatch.setattr(local_map_module, "MEMORY_FRAMES", frames)
        views = views_of([observe(world, pose, seed=i) for i, pose in enumerate(TRUTH)])
        local_map = start_map(views[:20], CAMERA, OdometrySettings(), descriptor_distance=0.7)
        assert isinstance(local_map, LocalMap)
        local_map.localise(views[20], views[19])
        observed.append(len(views[20].observed))
    assert observed[1] < observed[0]


@pytest.mark.parametrize(("frames", "reached"), [(1, False), (8, True)])
def test_a_place_that_the_camera_cannot_have_reached_is_another_that_looks_alike(
    mapped: tuple[LocalMap, list[View]], frames: int, reached: bool
) -> None:
    """Seventeen steps back within one frame is impossible, and within eight it is not."""
    local_map, views = mapped
    seen = observe(room(), TRUTH[2], seed=77)
    back = views_of([seen])[0]
    back.frame_index, back.tracks = 19 + frames, back.tracks + 10**6
    local_map.localise(back, views[19])
    assert (back.cam_from_world is not None) is reached
