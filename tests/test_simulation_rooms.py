"""The simulated world before anything is drawn: seeds, paths, image motion, sensor, causes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from improvo.errors import ConfigError
from improvo.geometry.camera import Camera
from improvo.geometry.se3 import rigid, so3_exp
from improvo.simulation import bundled_sequence
from improvo.simulation.causes import _depth_discontinuities, _shadow_edges
from improvo.simulation.flow import image_motion, pixel_grid
from improvo.simulation.scene import build_scene
from improvo.simulation.sensor import Sensor
from improvo.simulation.settings import PRESETS, SimulationSettings, preset

PERFECT = {"noise": 0.0, "vignetting": 0.0, "exposure_drift": 0.0, "exposure_time": 0.0}


def test_the_same_seed_builds_the_same_world_and_another_seed_another_one() -> None:
    settings = preset("home", frames=30, seed=4, furniture=2, clutter=4, posters=2)
    one, same, other = (build_scene(s) for s in (settings, settings, replace(settings, seed=5)))
    assert one.builder.xml() == same.builder.xml()
    assert one.builder.assets == same.builder.assets
    assert one.builder.xml() != other.builder.xml()
    times = np.linspace(0, 1, 7)
    np.testing.assert_array_equal(one.camera.world_from_cam(times), same.camera.world_from_cam(times))


@pytest.mark.parametrize("seed", [1, 2])
def test_the_camera_walks_like_a_hand_and_never_through_furniture(seed: int) -> None:
    settings = preset("crowded", frames=150, seed=seed)
    scene = build_scene(settings)
    times = np.arange(settings.frames) / settings.fps
    poses = scene.camera.world_from_cam(times)
    assert scene.floor.clearance(poses[:, :2, 3]).min() > 0.05
    np.testing.assert_allclose(
        poses[:, :3, :3] @ poses[:, :3, :3].swapaxes(1, 2), np.eye(3)[None].repeat(150, 0), atol=1e-9
    )
    assert np.linalg.det(poses[:, :3, :3]).min() > 0.99
    assert poses[:, 2, 1].max() < -0.8  # the image's y axis points down
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert 0.5 * settings.speed / settings.fps < steps.mean() < 2 * settings.speed / settings.fps
    assert steps.max() < 0.05


def test_clearance_is_a_distance_outside_and_negative_inside() -> None:
    floor = build_scene(preset("easy", frames=10)).floor
    x0, y0, x1, y1 = floor.obstacles[-1]
    middle = np.array([[(x0 + x1) / 2, (y0 + y1) / 2], [(x0 + x1) / 2, y1 + 0.1]])
    clearance = floor.clearance(middle)
    assert clearance[0] < 0
    assert 0 < clearance[1] <= 0.1 + 1e-12


@pytest.mark.parametrize("name", PRESETS)
def test_presets_differ_in_what_they_should(name: str) -> None:
    assert preset(name).walkers == {"easy": 0, "home": 1, "crowded": 3}[name]


def test_wrong_settings_are_refused() -> None:
    with pytest.raises(ConfigError, match="easy, home, crowded"):
        preset("palace")
    with pytest.raises(ConfigError, match="frames"):
        SimulationSettings(frames=1)
    for change, said in (
        ({"noise": -2.0}, "`noise`: -2.0 is too small; at least 0"),
        ({"exposure_time": -0.1}, "`exposure_time`"),
        ({"balls": -1}, "`balls`"),
        ({"gloss": 1.5}, "`gloss`: 1.5 is a share between 0 and 1"),
        ({"plain_share": 0.6, "repeated_share": 0.6}, "not be more than 1 together"),
        ({"room_height": 0.3}, "`room_height`: 0.3 must lie between"),
        ({"turn": float("nan")}, "`turn`"),
    ):
        with pytest.raises(ConfigError, match=said):
            preset("home", **change)
    with pytest.raises(ConfigError, match="room_size"):
        SimulationSettings(room_size=(1.0, 2.0))


def test_image_motion_of_static_and_moving_points() -> None:
    camera = Camera(32, 24, 30.0, 30.0, 15.5, 11.5)
    depth = np.full((24, 32), 2.0, np.float32)
    depth[0, 0] = np.nan
    geom = np.zeros((24, 32), np.int64)
    geom[:, 16:] = 1
    geom[0, 0] = -1
    start = np.eye(4)
    to_the_right = rigid(np.eye(3), np.array([0.1, 0.0, 0.0]))
    geoms = np.stack([np.eye(4), rigid(so3_exp(np.array([0.0, 0.0, 0.3])), np.array([0.4, 0.1, 2.0]))])
    later = geoms.copy()
    later[1, :3, 3] += [0.1, 0.0, 0.0]
    flow = image_motion(camera, depth, geom, (start, to_the_right), (geoms, later), np.array([False, True]))
    np.testing.assert_allclose(flow[5:, :16], np.broadcast_to([-1.5, 0.0], (19, 16, 2)), atol=1e-12)
    np.testing.assert_allclose(flow[:, 16:], 0.0, atol=1e-12)  # moves with the camera
    np.testing.assert_array_equal(flow[0, 0], 0.0)


def test_a_perfect_sensor_changes_nothing() -> None:
    settings = SimulationSettings(width=64, height=48, **PERFECT)
    image = np.random.default_rng(0).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    np.testing.assert_array_equal(Sensor(settings).expose(image, np.full((48, 64, 2), 50.0), 0, 0.3), image)


def test_rolling_shutter_shears_the_picture_by_its_motion() -> None:
    settings = SimulationSettings(width=64, height=49, rolling_shutter=0.02, **PERFECT)
    x = pixel_grid(Camera(64, 49, 1, 1, 0, 0))[..., 0]
    ramp = np.repeat((2 * x)[..., None], 3, axis=2).astype(np.uint8)
    motion = np.zeros((49, 64, 2))
    motion[..., 0] = 200.0  # pixels per second to the right: 2 pixels in half the read-out
    seen = Sensor(settings).expose(ramp, motion, 0, 0.0)[..., 0].astype(int)
    assert seen[24, 30] == 60
    assert seen[0, 30] == 64  # read before the middle, when the picture was 2 pixels further left
    assert seen[48, 30] == 56


def test_blur_noise_and_vignetting_are_there_and_repeatable() -> None:
    image = np.zeros((48, 64, 3), np.uint8)
    image[:, 32:] = 200
    motion = np.full((48, 64, 2), 400.0)
    blurred = Sensor(SimulationSettings(width=64, height=48, **(PERFECT | {"exposure_time": 0.01}))).expose(
        image, motion, 0, 0
    )
    assert set(np.unique(blurred[24])) - {0, 200}
    noisy = SimulationSettings(width=64, height=48, noise=4.0, vignetting=0.4, colour=False)
    one, again, next_frame = (Sensor(noisy).expose(np.full_like(image, 128), 0 * motion, n, 0.1) for n in (3, 3, 4))
    np.testing.assert_array_equal(one, again)
    assert one.shape == (48, 64)
    assert (one != next_frame).mean() > 0.5
    assert one[:8, :8].mean() < 0.75 * one[20:28, 28:36].mean()


def test_depth_discontinuities_are_jumps_and_not_slopes() -> None:
    y, x = np.mgrid[:40, :60]
    slope = (1 / (0.3 + 0.004 * x + 0.003 * y)).astype(np.float32)  # a plane seen at a grazing angle
    assert not _depth_discontinuities(slope).any()
    step = slope.copy()
    step[:, 30:] *= 0.8
    found = _depth_discontinuities(step)
    assert found[1:-1, 29:31].all()
    assert not found[:, :28].any()
    assert not found[:, 33:].any()


def test_only_edges_of_shadows_that_move_count() -> None:
    lit = np.full((30, 40, 3), 150, np.uint8)
    shadowed = lit.copy()
    shadowed[:, :20] = 70
    moved = lit.copy()
    moved[:, :22] = 70
    assert not _shadow_edges(shadowed, lit, shadowed).any()
    edges = _shadow_edges(shadowed, lit, moved)
    assert edges[:, 19:21].all()
    assert not edges[:, :15].any()
    assert not edges[:, 26:].any()


def test_the_bundled_sequence_is_small_long_and_lively() -> None:
    import cv2

    from improvo.sequences import open_sequence

    folder = bundled_sequence()
    assert sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) <= 3 * 2**20
    sequence = open_sequence(folder)
    truth = sequence.ground_truth
    assert len(sequence) >= 120
    assert truth is not None
    assert truth.valid.all()
    assert np.linalg.norm(np.diff(truth.camera_centers, axis=0), axis=1).sum() > 1.5
    causes = [cv2.imread(str(folder / "labels" / f"{i:06d}.png"), cv2.IMREAD_GRAYSCALE) for i in range(0, 140, 10)]
    assert np.mean([(image == 1).mean() for image in causes]) > 0.02
    assert sequence.depth(0) is not None
