"""What the renderer draws: the same pixels from the same seed, and a truth that agrees with itself."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from improvo.cli.main import main
from improvo.geometry.se3 import inverse, rigid, so3_exp, transform
from improvo.sequences import open_sequence
from improvo.simulation.causes import Cause
from improvo.simulation.flow import pixel_grid
from improvo.simulation.generate import simulated_frames
from improvo.simulation.renderer import SceneRenderer, camera_of
from improvo.simulation.scene import build_scene
from improvo.simulation.settings import preset


def _draws() -> bool:
    """Whether MuJoCo is there and can draw; asked in another process, since its first import settles how it draws."""
    code = "import mujoco; mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 8, 8)"
    environment = {**os.environ, "MUJOCO_GL": os.environ.get("MUJOCO_GL", "osmesa")}
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True).returncode == 0


pytestmark = pytest.mark.skipif(not _draws(), reason="needs MuJoCo and OpenGL without a display (libosmesa6)")

SMALL = {"width": 240, "height": 180, "frames": 40, "furniture": 2, "clutter": 4, "posters": 3, "seed": 3}


@pytest.fixture(scope="module")
def renderer() -> Iterator[tuple[SceneRenderer, np.ndarray]]:
    settings = preset("home", **SMALL)
    scene = build_scene(settings)
    with SceneRenderer(scene, camera_of(settings.width, settings.height, settings.fov)) as drawn:
        yield drawn, scene.camera.world_from_cam(np.arange(settings.frames) / settings.fps)


def _landing(drawn: SceneRenderer, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """How far static points of the first view land from where they are in the second, in pixels."""
    camera = drawn.camera
    depth, geom = drawn.geometry(0.0, first)
    other_depth, other_geom = drawn.geometry(0.0, second)
    pixels = pixel_grid(camera)
    points = camera.unproject(pixels, np.nan_to_num(depth, nan=1.0).astype(np.float64))
    second_from_first = inverse(second) @ first
    points_second = transform(second_from_first, points)
    target = camera.project(points_second)
    place = np.rint(target).astype(int)
    inside = (
        (points_second[..., 2] > 0.1) & (place >= 2).all(-1) & (place < [camera.width - 2, camera.height - 2]).all(-1)
    )
    x, y = np.where(inside, place[..., 0], 0), np.where(inside, place[..., 1], 0)
    seen = inside & (other_geom[y, x] == geom) & (geom >= 0) & ~drawn.moving[geom]
    seen &= np.abs(other_depth[y, x] / points_second[..., 2] - 1) < 0.03  # not hidden
    assert seen.mean() > 0.2
    # where the second view's own pixels come from in the first: the residual left by the two pictures
    pictures = [drawn.image(0.0, pose, specular=False, shadows=False) for pose in (first, second)]
    grey = [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in pictures]
    x_map, y_map = (np.where(seen, target[..., axis], -10).astype(np.float32) for axis in (0, 1))
    warped = cv2.remap(grey[1], x_map, y_map, cv2.INTER_LINEAR)
    corners = cv2.goodFeaturesToTrack(grey[0], 400, 0.02, 5, mask=cv2.erode(seen.astype(np.uint8), np.ones((9, 9))))
    assert len(corners) > 20
    found, status, _ = cv2.calcOpticalFlowPyrLK(grey[0], warped, corners, None, winSize=(9, 9), maxLevel=1)
    return np.linalg.norm(found - corners, axis=-1)[status.astype(bool)]


def test_depth_pose_and_intrinsics_land_in_another_frame(renderer: tuple[SceneRenderer, np.ndarray]) -> None:
    drawn, poses = renderer
    for gap in (5, 25):
        assert np.median(_landing(drawn, poses[0], poses[gap])) < 0.3


def test_the_principal_point_is_right_under_a_rolled_camera(renderer: tuple[SceneRenderer, np.ndarray]) -> None:
    """Half a pixel of error in cx or cy would show as a whole pixel when the camera is turned upside down."""
    drawn, poses = renderer
    rolled = poses[10] @ rigid(so3_exp(np.array([0.0, 0.0, np.pi])), np.zeros(3))
    camera = drawn.camera
    upright, turned = (drawn.image(0.0, pose, specular=False) for pose in (poses[10], rolled))
    expected = camera.project(camera.unproject(pixel_grid(camera)) @ np.diag([-1.0, -1.0, 1.0]))
    np.testing.assert_allclose(expected, pixel_grid(camera)[::-1, ::-1], atol=1e-9)
    difference = np.abs(turned[::-1, ::-1].astype(int) - upright)
    assert np.median(difference) <= 1
    assert (difference.max(axis=-1) <= 4).mean() > 0.95
    assert np.median(_landing(drawn, poses[10], rolled)) < 0.3


def test_depth_is_metric(renderer: tuple[SceneRenderer, np.ndarray]) -> None:
    """Every ray from above the middle of the floor, straight down, ends on something between table and floor."""
    drawn, _ = renderer
    down = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]).T
    depth, _ = drawn.geometry(0.0, rigid(down, np.array([0.0, 0.0, 2.0])))
    assert np.isfinite(depth).all()
    assert 1.98 < np.percentile(depth, 99) < 2.02
    assert depth.min() > 0.1


def test_moving_pixels_are_those_that_move(renderer: tuple[SceneRenderer, np.ndarray]) -> None:
    drawn, _ = renderer
    before, after = drawn.geom_poses(0.1), drawn.geom_poses(0.6)
    changed = np.abs(after - before).max(axis=(1, 2)) > 1e-6
    assert changed[drawn.moving].mean() > 0.9
    assert not changed[~drawn.moving].any()


def test_the_same_seed_gives_the_same_pixels() -> None:
    settings = preset("crowded", **(SMALL | {"width": 96, "height": 72, "frames": 3}))
    runs = [list(simulated_frames(settings)) for _ in range(2)]
    for one, again in zip(*runs, strict=True):
        np.testing.assert_array_equal(one.image, again.image)
        np.testing.assert_array_equal(one.depth, again.depth)
        np.testing.assert_array_equal(one.causes, again.causes)
    assert (runs[0][0].image != runs[0][2].image).mean() > 0.2


def test_simulate_writes_a_sequence_that_opens(tmp_path: Path) -> None:
    folder = tmp_path / "room"
    words = ["simulate", "-o", str(folder), "--preset", "home", "--frames", "3", "--size", "96x72", "--seed", "2"]
    assert main([*words, "--set", "furniture=3", "--set", "clutter=4", "--depth-every", "2"]) == 0
    sequence = open_sequence(folder)
    assert (sequence.format, len(sequence), sequence.camera.width) == ("tum", 3, 96)
    assert sequence.ground_truth is not None
    assert sequence.ground_truth.valid.all()
    assert (sequence.depth(0) is not None, sequence.depth(1) is None) == (True, True)
    labels = [cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in sorted((folder / "labels").iterdir())]
    assert len(labels) == 3
    assert all(image.shape == (72, 96) and image.max() <= max(Cause) for image in labels)
    assert any((image == Cause.DEPTH_DISCONTINUITY).any() for image in labels)


def test_many_scenes_in_parallel(tmp_path: Path) -> None:
    words = ["simulate", "-o", str(tmp_path / "rooms"), "--preset", "easy", "--frames", "2", "--size", "64x48"]
    assert main([*words, "--scenes", "2", "--workers", "2", "--set", "furniture=1", "--set", "posters=1"]) == 0
    first, second = (open_sequence(tmp_path / "rooms" / name) for name in ("scene-0000", "scene-0001"))
    assert (first[0].image != second[0].image).mean() > 0.5


def test_simulate_refuses_what_it_cannot_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    assert main(["simulate", "-o", str(tmp_path)]) == 2
    assert "improvo did not write" in capsys.readouterr().err
    assert main(["simulate", "-o", str(tmp_path / "new"), "--size", "wide"]) == 2
    assert main(["simulate", "-o", str(tmp_path / "new"), "--set", "walker=2"]) == 2
    assert "walkers" in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
