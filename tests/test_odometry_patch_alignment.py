"""Patches found again to a tenth of a pixel, and refused where they have no place of their own."""

from __future__ import annotations

import numpy as np
import pytest

from improvo.geometry import se3
from improvo.odometry.refinement.patch_alignment import (
    REACH,
    Aligned,
    align,
    cut_patches,
    patch_middles,
    repeated,
    warps_between,
)
from improvo.types import Float64, UInt8

_RNG = np.random.default_rng(3)
_WAVES = _RNG.uniform(-0.6, 0.6, (60, 2))  # radians per pixel
_PHASES = _RNG.uniform(0, 2 * np.pi, 60)


def grey(places: Float64) -> Float64:
    """The scene's brightness (...) at places (..., 2), known everywhere."""
    return np.asarray(120 + 9 * np.cos(places @ _WAVES.T + _PHASES).sum(axis=-1))


def picture(warp: Float64, shift: Float64, gain: float = 1.0, offset: float = 0.0, noise: float = 0.0) -> UInt8:
    """(160, 160) what a camera sees whose pixel p shows the scene at middle + warp (p - middle - shift)."""
    y, x = np.mgrid[:160, :160]
    pixels = np.stack([x, y], axis=-1) - 80.0 - shift
    values = gain * grey(pixels @ warp.T + 80.0) + offset
    values += np.random.default_rng(5).normal(0, noise, values.shape) if noise else 0
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


STILL = picture(np.eye(2), np.zeros(2))
POINTS = np.stack(np.meshgrid(np.arange(30.0, 131.0, 10.0), np.arange(30.0, 131.0, 10.0)), axis=-1).reshape(-1, 2) + 0.3


def find(image: UInt8, starts: Float64, warp: Float64, max_move: float = 1.5) -> Aligned:
    """The patches of the points of the still picture, in another one."""
    patches, warps = cut_patches(STILL, POINTS), np.repeat(warp[None], len(POINTS), axis=0)
    return align(image, starts, patches, patch_middles(POINTS), warps, max_move)


@pytest.mark.parametrize(
    ("warp", "predicted"),
    [
        (np.eye(2), np.eye(2)),
        (np.array([[1.2, 0.15], [-0.1, 0.9]]), np.array([[1.2, 0.15], [-0.1, 0.9]])),
        (np.array([[1.06, 0.05], [-0.04, 0.95]]), np.eye(2)),  # not quite as predicted
    ],
)
def test_a_shift_is_found_under_a_warp_with_gain_offset_and_noise(warp: Float64, predicted: Float64) -> None:
    shift = np.array([0.62, -0.41])
    image = picture(warp, shift, gain=0.8, offset=25.0, noise=1.5)
    true = (POINTS - 80.0) @ np.linalg.inv(warp).T + 80.0 + shift
    inside = ((true > 10) & (true < 150)).all(axis=1)
    found = find(image, true + np.array([0.5, -0.6]), predicted)
    good = inside & (found.correlation > 0.9)
    errors = np.linalg.norm(found.places - true, axis=1)[good]
    assert good.sum() > 0.8 * inside.sum()
    assert np.median(errors) < 0.08
    assert np.quantile(errors, 0.95) < 0.25
    assert 0.3 < np.median(errors) / np.median(found.deviation[good]) < 3.0  # it knows how exact it is


def test_no_place_is_farther_than_the_limit() -> None:
    found = find(picture(np.eye(2), np.array([2.0, 0.0])), POINTS, np.eye(2), max_move=1.5)
    assert (np.linalg.norm(found.places - POINTS, axis=1) <= 1.5).all()
    assert (found.correlation < -1).sum() > 0.8 * len(POINTS)  # two pixels away are too far


def test_what_is_not_found_stays() -> None:
    other = np.random.default_rng(0).integers(0, 255, (160, 160)).astype(np.uint8)
    found = find(other, POINTS, np.eye(2))
    assert (found.places[found.correlation < -1] == POINTS[found.correlation < -1]).all()
    assert (found.correlation < 0.8).all()


@pytest.mark.parametrize(
    "image", [np.full((160, 160), 90, np.uint8), np.tile(np.arange(160, dtype=np.uint8), (160, 1))]
)
def test_a_flat_patch_and_an_edge_are_refused(image: UInt8) -> None:
    patches, warps = cut_patches(image, POINTS), np.repeat(np.eye(2)[None], len(POINTS), axis=0)
    found = align(image, POINTS, patches, patch_middles(POINTS), warps, 1.5)
    assert (found.correlation < -1).all()


def test_a_pattern_that_repeats_within_reach_is_refused_and_a_corner_is_not() -> None:
    y, x = np.mgrid[:160, :160]
    grid = (120 + 60 * np.cos(2 * np.pi * x / 4) * np.cos(2 * np.pi * y / 4)).astype(np.uint8)
    corner = np.where((x > 80) & (y > 80), 200, 40).astype(np.uint8)
    middle = np.array([[80.0, 80.0]])
    assert repeated(cut_patches(grid, middle)).all()
    assert repeated(cut_patches(np.full((160, 160), 90, np.uint8), middle)).all()
    assert not repeated(cut_patches(corner, middle)).any()
    assert repeated(cut_patches(STILL, POINTS)).mean() < 0.1


def test_patches_at_the_edge_and_warps_that_look_too_far_do_no_harm() -> None:
    corners = np.array([[0.0, 0.0], [159.0, 159.0], [0.0, 159.4], [80.0, 80.0]])
    patches = cut_patches(STILL, corners)
    assert patches.shape == (4, 2 * REACH + 1, 2 * REACH + 1)
    warps = np.stack([np.eye(2), np.eye(2), np.eye(2), 5.0 * np.eye(2)])
    found = align(STILL, corners, patches, patch_middles(corners), warps, 1.5)
    assert (found.places == corners).all()
    assert (found.correlation < -1).all()


def test_the_same_twice_gives_the_same_bytes() -> None:
    image = picture(np.eye(2), np.array([0.3, 0.2]), noise=2.0)
    first, second = find(image, POINTS, np.eye(2)), find(image, POINTS, np.eye(2))
    for name in ("places", "correlation", "deviation"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()


def test_the_warp_is_that_of_a_plane_before_the_anchors_camera() -> None:
    anchor_from_world, depth = np.eye(4), 4.0
    cam_from_world = se3.rigid(se3.so3_exp(np.array([0.05, -0.2, 0.3])), np.array([0.3, -0.2, 0.9]))
    point, focal = np.array([0.7, -0.4, depth]), np.array([500.0, 520.0])

    def seen(offset: Float64) -> Float64:
        """Pixels, but for the principal point, of the plane's point `offset` pixels beside in the anchor's picture."""
        there = se3.transform(cam_from_world, (point + np.append(offset * depth / focal, 0.0))[None])[0]
        return np.asarray(focal * there[:2] / there[2])

    step = 1e-4
    forward = np.stack([(seen(step * axis) - seen(-step * axis)) / (2 * step) for axis in np.eye(2)], axis=1)
    rotation = (cam_from_world @ se3.inverse(anchor_from_world))[None, :3, :3]
    xyz_cam = se3.transform(cam_from_world, point[None])
    warps, good = warps_between(rotation, xyz_cam, np.array([depth]), focal)
    assert good.all()
    np.testing.assert_allclose(warps[0], np.linalg.inv(forward), atol=1e-6)
    _, behind = warps_between(rotation, -xyz_cam, np.array([depth]), focal)
    assert not behind.any()
