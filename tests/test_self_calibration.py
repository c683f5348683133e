"""A camera from the motion of a video: known lenses are recovered, and motions that do not tell them are refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from simulated_features import World, hand_motion, room, wall

from improvo.errors import InputError
from improvo.frontend.registry import load_frontend
from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.self_calibration.adjustment import Scene, adjusted
from improvo.self_calibration.first_guess import agreement, far_pairs, guesses
from improvo.self_calibration.from_motion import (
    CameraFromMotion,
    LensFound,
    _cost_beside,
    _fit,
    lens_of_pieces,
    refuse_unsure,
)
from improvo.self_calibration.lens import MODELS, NAMES, Lens, lens_with_fov
from improvo.self_calibration.raw_features import Piece, detect_pieces, open_raw, piece_rows
from improvo.self_calibration.settings import SelfCalibrationSettings
from improvo.sequences.base import SequenceSettings
from improvo.types import Features, Float64

BROWN = Lens(np.array([420.0, 420.5, 330.0, 236.0, -0.28, 0.08]), "brown", 640, 480)
FISHEYE = Lens(np.array([300.0, 300.4, 318.0, 243.0, 0.04, -0.02]), "fisheye", 640, 480)
SMALL = Lens(np.array([260.0, 260.0, 161.0, 118.0, -0.1, 0.02]), "brown", 320, 240)
SETTINGS = SelfCalibrationSettings(pairs=8, views=30, rounds=3)


def scene(lens: Lens, seed: int, views: int = 16, points: int = 300, noise: float = 0.3) -> Scene:
    """Views from all sides of a cloud of points; each sees half of them."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-1, 1, (points, 3)) * (4, 3, 2) + (0, 0, 6)
    rotation = se3.so3_exp(rng.normal(scale=0.15, size=(views, 3)))
    centre = rng.normal(scale=0.8, size=(views, 3)) * (1, 0.5, 0.7)
    poses = se3.rigid(rotation, -np.einsum("vij,vj->vi", rotation, centre))
    return observed(lens, poses, xyz, rng, noise)


def observed(
    lens: Lens,
    poses: Float64,
    xyz: Float64,
    rng: np.random.Generator,
    noise: float,
    motion: Float64 | None = None,
    readout: float = 0.0,
) -> Scene:
    point, view = (each.ravel() for each in np.indices((len(xyz), len(poses))))
    points_cam = np.einsum("mij,mj->mi", poses[view, :3, :3], xyz[point]) + poses[view, :3, 3]
    motion = np.zeros((len(poses), 6)) if motion is None else motion
    moved, pixels = points_cam, lens.project(points_cam)[0]
    for _ in range(5):  # the row decides when a point was seen, and that decides the row
        when = (pixels[:, 1] - (lens.height - 1) / 2) / lens.height * readout
        speed = motion[view, :3] + np.cross(motion[view, 3:], points_cam)
        moved = points_cam + when[:, None] * speed
        pixels = lens.project(moved)[0]
    seen = (pixels > 0).all(axis=1) & (pixels < (lens.width, lens.height)).all(axis=1) & (rng.random(len(view)) < 0.5)
    pixels = pixels[seen] + rng.normal(scale=noise, size=(int(seen.sum()), 2))
    world = np.zeros(len(poses), np.int64)
    whole = Scene(lens, poses, xyz, view[seen], point[seen], pixels, world, motion)
    return whole.only(whole.kept(np.zeros(len(pixels), bool)))


def disturbed(truth: Scene, lens: Lens, seed: int) -> Scene:
    rng = np.random.default_rng(seed)
    return replace(truth, lens=lens, xyz=truth.xyz + rng.normal(scale=0.05, size=truth.xyz.shape))


def piece(world: World, motion: Float64, lens: Lens = SMALL, noise: float = 0.3, seed: int = 0) -> Piece:
    """Features of a walk through a world by a lens: pixel noise, descriptor noise, a third of the points missed."""
    rng = np.random.default_rng(seed)
    frames = []
    for world_from_cam in motion:
        points_cam = se3.transform(se3.inverse(world_from_cam), world.points)
        with np.errstate(invalid="ignore"):
            pixels = lens.project(points_cam)[0]
            x, y = points_cam[:, 0] / points_cam[:, 2], points_cam[:, 1] / points_cam[:, 2]
        seen = (pixels > 0).all(axis=1) & (pixels < (lens.width, lens.height)).all(axis=1) & (np.hypot(x, y) < 1.2)
        rows = np.flatnonzero(seen & (rng.random(len(seen)) < 0.7))[:400]
        descriptors = world.descriptors[rows] + rng.normal(scale=0.04, size=(len(rows), world.descriptors.shape[1]))
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        keypoints = pixels[rows] + rng.normal(scale=noise, size=(len(rows), 2))
        frames.append(Features(keypoints.astype(np.float32), descriptors.astype(np.float32), rng.random(len(rows))))
    return Piece(tuple(frames), tuple(np.arange(len(frames)) / 30.0))


def result(found: LensFound) -> CameraFromMotion:
    """What the whole search would say of it."""
    *deviations, readout = np.sqrt(np.diag(found.adjusted.covariance)).tolist()
    lens = found.adjusted.scene.lens
    counts = {"frames": 60, "tracked": found.tracked, "views": 30, "points": 500, "observations": 5000}
    return CameraFromMotion(
        lens.camera,
        dict(zip(NAMES, deviations, strict=True)),
        found.adjusted.rms,
        fov=lens.fov,
        readout=found.adjusted.scene.readout,
        readout_deviation=readout,
        **counts,
    )


@pytest.mark.parametrize("lens", [BROWN, FISHEYE], ids=MODELS)
def test_a_lens_projects_as_its_camera_and_back(lens: Lens) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (50, 3)) * (1.5, 1.0, 0.5) + (0, 0, 2.5)
    pixels, by_point, by_value = lens.project(points)
    camera = lens.camera
    expected = camera.distort(points[:, :2] / points[:, 2:]) * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    np.testing.assert_allclose(pixels, expected, atol=1e-9)
    np.testing.assert_allclose(lens.rays(pixels), points[:, :2] / points[:, 2:], atol=1e-9)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx(tuple(lens.values[:4]))
    step = 1e-6
    for i in range(3):
        moved = np.eye(3)[i] * step
        slope = (lens.project(points + moved)[0] - lens.project(points - moved)[0]) / (2 * step)
        np.testing.assert_allclose(by_point[..., i], slope, atol=1e-5)
    for i in range(6):
        more, less = (replace(lens, values=lens.values + sign * step * np.eye(6)[i]) for sign in (1, -1))
        slope = (more.project(points)[0] - less.project(points)[0]) / (2 * step)
        np.testing.assert_allclose(by_value[..., i], slope, atol=1e-5)


def test_pixels_without_a_ray_and_points_behind_are_nan() -> None:
    folding = Lens(np.array([300.0, 300.0, 319.5, 239.5, -0.4, 0.0]), "brown", 640, 480)
    assert np.isnan(folding.rays(np.array([[0.0, 0.0]]))).all()
    assert np.isfinite(folding.rays(np.array([[319.5, 239.5]]))).all()
    assert np.isnan(folding.project(np.array([[0.1, 0.1, -1.0]]))[0]).all()


@pytest.mark.parametrize("fov", [40.0, 60.0, 90.0, 120.0])
@pytest.mark.parametrize("model", MODELS)
def test_a_lens_of_a_field_of_view_has_it(fov: float, model: str) -> None:
    assert lens_with_fov(fov, 640, 480, model).fov == pytest.approx(fov, abs=0.2)


def test_the_other_model_of_a_lens_projects_alike() -> None:
    pixels = np.random.default_rng(1).uniform((0, 0), (640, 480), (200, 2))
    for lens, limit in ((BROWN, 3.0), (FISHEYE, 20.0)):
        other = lens.as_model(MODELS[1 - MODELS.index(lens.model)])
        rays = np.column_stack([lens.rays(pixels), np.ones(len(pixels))])
        near = np.linalg.norm(pixels - (320, 240), axis=1) < 250
        assert np.linalg.norm(other.project(rays[near])[0] - pixels[near], axis=1).max() < limit


@pytest.mark.parametrize("lens", [BROWN, FISHEYE], ids=MODELS)
def test_a_known_lens_is_recovered_to_its_deviation(lens: Lens) -> None:
    start = lens_with_fov(65 if lens.model == "brown" else 85, 640, 480, lens.model)
    shares = []
    for seed in range(4):
        found = adjusted(disturbed(scene(lens, seed), start, seed))
        off = (found.scene.lens.values - lens.values) / np.sqrt(np.diag(found.covariance))[:6]
        assert np.abs(off).max() < 4
        assert np.sqrt(found.covariance[0, 0]) < 0.004 * lens.values[0]
        shares.append(off)
    assert 0.4 < np.sqrt((np.array(shares) ** 2).mean()) < 1.8


def test_a_rolling_shutter_is_found_and_does_not_bend_the_lens() -> None:
    rng = np.random.default_rng(3)
    still = scene(BROWN, 3)
    motion = rng.normal(scale=(0.3, 0.3, 0.3, 0.5, 0.5, 0.5), size=(len(still.cam_from_world), 6))
    truth = observed(BROWN, still.cam_from_world, still.xyz, rng, 0.3, motion, 0.03)
    found = adjusted(disturbed(truth, lens_with_fov(70, 640, 480), 0))
    deviation = np.sqrt(np.diag(found.covariance))
    assert found.scene.readout == pytest.approx(0.03, abs=4 * deviation[6])
    assert deviation[6] < 0.003
    assert (np.abs(found.scene.lens.values - BROWN.values) < 4 * deviation[:6]).all()


def test_wrong_observations_do_not_move_the_lens() -> None:
    truth = scene(BROWN, 0)
    rng = np.random.default_rng(5)
    wrong = rng.random(len(truth.view)) < 0.05
    spoiled = truth.pixels + wrong[:, None] * rng.normal(scale=20, size=truth.pixels.shape)
    found = adjusted(replace(truth, pixels=spoiled))
    assert found.scene.lens.values[:2] == pytest.approx(BROWN.values[:2], rel=0.005)


def test_forward_motion_says_that_it_does_not_know() -> None:
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-1, 1, (300, 3)) * (4, 3, 2) + (0, 0, 8)
    centre = np.outer(np.arange(16), (0.0, 0.0, 0.15))
    rotation = se3.so3_exp(rng.normal(scale=0.001, size=(16, 3)))
    truth = observed(BROWN, se3.rigid(rotation, -np.einsum("vij,vj->vi", rotation, centre)), xyz, rng, 0.3)
    assert np.sqrt(adjusted(truth).covariance[0, 0]) > 0.03 * BROWN.values[0]


def test_the_whole_search_finds_the_lens_of_a_walk() -> None:
    found = lens_of_pieces([piece(room(), hand_motion(60))], 320, 240, SETTINGS)
    lens, deviation = found.adjusted.scene.lens, np.sqrt(np.diag(found.adjusted.covariance))[:6]
    assert lens.values[:2] == pytest.approx(SMALL.values[:2], rel=0.01)
    assert (np.abs(lens.values - SMALL.values) < 4 * deviation).all()
    assert found.tracked > 50
    refuse_unsure(result(found), "walk", SETTINGS)


def test_the_first_guess_is_near_and_the_truth_agrees_best() -> None:
    pairs = far_pairs([piece(room(), hand_motion(60))], 320, 8, 0.7, 0)
    tried = guesses(pairs, 320, 240, "auto", 0, lambda done, total: None)
    assert abs(np.log(tried[0].lens.values[0] / SMALL.values[0])) < 0.3
    assert agreement(pairs, SMALL, 0) > tried[0].score - 0.01


def turning(frames: int) -> Float64:
    """In one place, to the side and up and down."""
    time = np.arange(frames) / frames
    turn = np.stack([0.1 * np.sin(9 * time), 0.8 * time, 0.05 * np.sin(5 * time)], axis=1)
    return se3.rigid(se3.so3_exp(turn), np.zeros((frames, 3)))


def forward(frames: int) -> Float64:
    return se3.rigid(np.broadcast_to(np.eye(3), (frames, 3, 3)), np.outer(np.arange(frames), (0, 0, 0.02)))


@pytest.mark.parametrize(
    ("motion", "world"),
    [
        (np.broadcast_to(np.eye(4), (40, 4, 4)), room()),
        (turning(50), room()),
        (forward(50), room()),
        (se3.rigid(np.broadcast_to(np.eye(3), (50, 3, 3)), np.outer(np.arange(50), (0.02, 0, 0))), wall(tilt=0.0)),
    ],
    ids=["still", "turning", "forward", "wall"],
)
def test_motions_that_do_not_tell_the_camera_are_refused(motion: Float64, world: World) -> None:
    with pytest.raises(InputError, match=r"^video: .*; walk sideways") as error:
        refuse_unsure(result(lens_of_pieces([piece(world, motion)], 320, 240, SETTINGS, "video")), "video", SETTINGS)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"fov": float("nan")}, "the distortion found has no inverse"),
        ({"deviations": dict.fromkeys(NAMES, float("nan"))}, "leaves the focal length open"),
        ({"deviations": dict.fromkeys(NAMES, float("inf"))}, "open: no focal length fits better than another; walk"),
        (
            {"deviations": dict.fromkeys(NAMES, 0.05 * SMALL.camera.fx)},
            r"px \+- 5\.0 %, where 1 % is .*; --fov \d+ takes",
        ),
        ({"deviations": dict.fromkeys(NAMES, 0.2 * SMALL.camera.fx)}, r"px \+- 20\.0 %, where 1 % is .*\); walk"),
        ({"rms": float("nan")}, "no camera explains it"),
    ],
)
def test_a_camera_without_numbers_is_refused(change: dict[str, Any], said: str) -> None:
    good = CameraFromMotion(SMALL.camera, dict.fromkeys(NAMES, 0.1), 0.4, 60, 60, 30, 200, 2000, SMALL.fov, 0.0, 0.001)
    refuse_unsure(good, "walk", SETTINGS)
    with pytest.raises(InputError, match=said):
        refuse_unsure(replace(good, **change), "walk", SETTINGS)


@pytest.mark.parametrize("name", ["sift", "akaze"])
def test_keypoints_are_where_the_picture_has_them(name: str, tmp_path: Path) -> None:
    """A principal point can be no better than they are; OpenCV's SIFT is a quarter of a pixel off by itself."""
    rng = np.random.default_rng(0)
    centres = np.stack(np.meshgrid(np.arange(40, 300, 50), np.arange(40, 220, 50)), axis=-1).reshape(-1, 2)
    centres = centres + rng.uniform(0, 1, centres.shape)
    y, x = np.mgrid[:240, :320]
    picture = np.full((240, 320), 110.0)
    for centre, size in zip(centres, rng.uniform(3, 7, len(centres)), strict=True):
        picture += 100 * np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2 * size**2))
    assert cv2.imwrite(str(tmp_path / "0.png"), picture.astype(np.uint8))
    assert cv2.imwrite(str(tmp_path / "1.png"), picture.astype(np.uint8))
    sequence = open_raw(tmp_path, SequenceSettings())
    (found,) = detect_pieces(sequence, [range(2)], load_frontend(name, 500))
    off = found.features[0].keypoints[:, None] - centres
    nearest = np.linalg.norm(off, axis=2).argmin(axis=0)
    errors = off[nearest, np.arange(len(centres))]
    errors = errors[np.linalg.norm(errors, axis=1) < 1]
    assert len(errors) > 10
    assert np.abs(np.median(errors, axis=0)).max() < 0.06


def test_a_model_is_charged_for_what_it_leaves_out() -> None:
    """Without the rim of the picture, a model that is wrong there looks as good as the right one."""
    whole = scene(FISHEYE, 0)
    wrong, right = (_fit(whole, FISHEYE.as_model(model)) for model in MODELS)
    left_out = right.kept & ~wrong.kept
    assert left_out.sum() > 10
    middle = np.array([FISHEYE.width / 2, FISHEYE.height / 2])
    radius = np.linalg.norm(whole.pixels - middle, axis=1)
    assert np.median(radius[left_out]) > 1.3 * np.median(radius)
    alone = wrong.adjusted.cost / wrong.kept.sum()
    assert _cost_beside(wrong, right) > 1.02 * alone
    assert _cost_beside(right, right) == pytest.approx(right.adjusted.cost / right.kept.sum())
    assert _cost_beside(right, wrong) < 0.9 * _cost_beside(wrong, right)


def test_a_lens_that_folds_within_the_picture_has_no_field_of_view() -> None:
    assert np.isnan(Lens(np.array([300.0, 310.0, 322.0, 241.0, -0.35, 0.0]), "brown", 640, 480).fov)


def test_pieces_cover_short_videos_and_sample_long_ones() -> None:
    slow, fast = np.arange(1000) / 10, np.arange(1000) / 30
    assert piece_rows(slow[:300], 400, 2, 15.0) == [range(300)]
    assert piece_rows(slow, 400, 2, 15.0) == [range(200), range(800, 1000)]
    assert piece_rows(fast, 400, 2, 15.0) == [range(0, 400, 2), range(600, 1000, 2)]
    assert piece_rows(fast[:300], 400, 2, 15.0) == [range(0, 300, 2)]


def test_a_found_camera_of_larger_pictures_is_scaled() -> None:
    small = SMALL.camera
    large = small.resized(640, 480)
    assert isinstance(large, Camera)
    assert large.distortion == small.distortion
    assert large.fx == 2 * small.fx
