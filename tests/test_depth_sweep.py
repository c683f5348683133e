"""The depth map of one frame over known poses."""

from __future__ import annotations

import numpy as np
import pytest

from depth_scene import CAMERA, Plane, halved, plain, render, sideways, textured, wall
from improvo.depth import DepthMap
from improvo.depth.frame_depth import sweep_depth
from improvo.depth.neighbours import choose_neighbours
from improvo.depth.settings import DepthSettings, NeighbourSettings
from improvo.errors import ConfigError
from improvo.types import Float64

FRAMES = 9
MIDDLE = FRAMES // 2
RANGE = (1.0, 2.0, 6.0)


def swept(planes: list[Plane], poses: Float64, **options: object) -> tuple[DepthMap, np.ndarray]:
    """The depth map of the middle frame, and its true depth."""
    pictures = [render(planes, pose) for pose in poses]
    images = [image for image, _ in pictures]
    found = sweep_depth(images, poses, CAMERA.K, MIDDLE, range(FRAMES), **options)  # type: ignore[arg-type]
    return found, halved(pictures[MIDDLE][1])


def errors(found: DepthMap, truth: np.ndarray) -> np.ndarray:
    """Relative errors of the known pixels."""
    known = found.depth > 0
    return np.asarray(np.abs(found.depth[known] / truth[known] - 1))


@pytest.mark.parametrize("depth_range", [RANGE, None])
def test_a_wall_is_where_it_is(depth_range: tuple[float, float, float] | None) -> None:
    found, truth = swept([wall(2.0, textured(0))], sideways(FRAMES, 0.06), depth_range=depth_range)
    assert found.depth.shape == (CAMERA.height // 2, CAMERA.width // 2)
    assert found.depth.dtype == np.float32
    assert found.known > 0.85
    assert np.median(errors(found, truth)) < 0.003
    assert (errors(found, truth) > 0.03).mean() < 0.005
    assert ((found.confidence > 0) == (found.depth > 0)).all()
    assert found.confidence.max() <= 1


@pytest.mark.parametrize("frames", [2, 3, 5])
def test_one_or_two_neighbours_are_enough(frames: int) -> None:
    pictures = [render([wall(2.0, textured(0))], pose) for pose in sideways(frames, 0.1)]
    images = [image for image, _ in pictures]
    settings = DepthSettings(neighbours=NeighbourSettings(least=1, most=2))
    found = sweep_depth(images, sideways(frames, 0.1), CAMERA.K, frames // 2, range(frames), RANGE, settings)
    assert found.known > 0.7
    assert np.median(errors(found, halved(pictures[frames // 2][1]))) < 0.01


def test_a_slanted_floor_and_a_near_wall_before_it() -> None:
    floor = Plane((-5.0, 0.6, 0.5), (10.0, 0, 0), (0, -0.3, 6.0), textured(1))
    near = wall(1.5, textured(2), half_width=0.5, middle=0.2)
    found, truth = swept([wall(4.0, textured(3)), floor, near], sideways(FRAMES, 0.05))
    assert found.known > 0.7
    assert np.median(errors(found, truth)) < 0.006
    assert (errors(found, truth) > 0.05).mean() < 0.05
    is_near = (truth > 1.4) & (truth < 1.6)
    assert (found.depth[is_near] > 0).mean() > 0.8


def test_the_same_bytes_again() -> None:
    scene, poses = [wall(2.0, textured(0))], sideways(FRAMES, 0.06)
    first, second = swept(scene, poses)[0], swept(scene, poses)[0]
    assert first.depth.tobytes() == second.depth.tobytes()
    assert first.confidence.tobytes() == second.confidence.tobytes()


@pytest.mark.parametrize("depth_range", [RANGE, None])
def test_a_camera_that_stands_still_or_only_turns_knows_nothing(
    depth_range: tuple[float, float, float] | None,
) -> None:
    poses = sideways(FRAMES, 0.06)
    poses[:, :3, 3] = 0
    found, _ = swept([wall(2.0, textured(0))], poses, depth_range=depth_range)
    assert found.known == 0


@pytest.mark.parametrize("depth_range", [RANGE, None])
def test_a_wall_without_texture_knows_nothing(depth_range: tuple[float, float, float] | None) -> None:
    found, _ = swept([wall(2.0, plain())], sideways(FRAMES, 0.06), depth_range=depth_range)
    assert found.known == 0


def test_frames_without_a_pose_are_left_out() -> None:
    scene, poses = [wall(2.0, textured(0))], sideways(FRAMES, 0.06)
    pictures = [render(scene, pose)[0] for pose in poses]
    poses[[1, 6]] = np.nan
    found = sweep_depth(pictures, poses, CAMERA.K, MIDDLE, range(FRAMES), RANGE)
    assert found.known > 0.8
    poses[MIDDLE] = np.nan
    assert sweep_depth(pictures, poses, CAMERA.K, MIDDLE, range(FRAMES), RANGE).known == 0
    assert sweep_depth(pictures, poses, CAMERA.K, MIDDLE, range(FRAMES)).known == 0


def test_wrong_poses_give_little() -> None:
    scene, poses = [wall(2.0, textured(0))], sideways(FRAMES, 0.06)
    images = [render(scene, pose)[0] for pose in poses]
    wrong = sideways(FRAMES, 0.06)
    wrong[:, 1, 3] += 0.2 * np.resize([1, -1, 0.5, -0.5, 0], FRAMES)  # 26 pixels up and down
    assert sweep_depth(images, wrong, CAMERA.K, MIDDLE, range(FRAMES), RANGE).known < 0.02


def test_neighbours_lie_on_both_sides_within_the_baselines_and_the_turn() -> None:
    poses = sideways(41, 0.02)
    poses[25:, :3, :3] = poses[25, :3, :3] @ np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    rules = NeighbourSettings(most=6)
    chosen = choose_neighbours(poses, CAMERA.K, (320, 240), 20, range(41), 2.0, rules)
    baselines = np.abs(np.array(chosen) - 20) * 0.02 / 2.0
    assert chosen == sorted(chosen)
    assert len(chosen) == 6
    assert any(row < 20 for row in chosen)
    assert all(20 < row < 25 for row in chosen if row > 20)
    assert (baselines > 0.029).all()
    assert (baselines < 0.16).all()


def test_impossible_settings_are_refused() -> None:
    with pytest.raises(ConfigError, match="min_baseline"):
        NeighbourSettings(min_baseline=0.2, max_baseline=0.1)
    with pytest.raises(ConfigError, match="least"):
        NeighbourSettings(least=9, most=8)
