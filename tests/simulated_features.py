"""A made-up world of points with descriptors, seen by a moving camera: features without images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from improvo.geometry import se3
from improvo.geometry.alignment import align_points
from improvo.geometry.camera import Camera
from improvo.odometry.view import View
from improvo.tracking.connect import TrackChain
from improvo.tracking.matching import match_units, unit_descriptors
from improvo.types import Features, Float64

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)


@dataclass(frozen=True)
class World:
    """Points (P, 3), each with a unit descriptor (P, D)."""

    points: Float64
    descriptors: Float64


def room(seed: int = 0, count: int = 3000) -> World:
    """Points on the walls of a room of 6 x 4 x 6 around the origin, and inside it."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (count, 3)) * (3.0, 2.0, 3.0)
    wall = rng.integers(0, 4, count)
    points[wall == 0, 2] = 3.0
    points[wall == 1, 0] = 3.0
    points[wall == 2, 1] = 2.0
    descriptors = rng.normal(size=(count, 32))
    return World(points, descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True))


def hand_motion(frames: int, step: float = 0.02, turn_deg: float = 0.4, seed: int = 0) -> Float64:
    """world_from_cam (N, 4, 4): sideways and forward with a slow turn and a little shake."""
    rng = np.random.default_rng(seed)
    time = np.arange(frames)
    shake = np.cumsum(rng.normal(scale=0.05 * step, size=(frames, 3)), axis=0)
    along = np.stack([step * time, 0.1 * np.sin(time / 9.0), 0.4 * step * time], axis=1)
    position = along + shake - (0.5, 0.0, 2.0)
    turn = np.stack([0.02 * np.sin(time / 11.0), np.radians(turn_deg) * time, 0.02 * np.sin(time / 7.0)], axis=1)
    return se3.rigid(se3.so3_exp(turn), position)


def observe(world: World, world_from_cam: Float64, seed: int, noise: float = 0.4, limit: int = 400) -> Features:
    """Features of one view: pixel noise, descriptor noise, a third of the points missed."""
    rng = np.random.default_rng(seed)
    points_cam = se3.transform(se3.inverse(world_from_cam), world.points)
    pixels = CAMERA.project(points_cam)
    visible = (points_cam[:, 2] > 0.1) & (pixels > 0).all(axis=1) & (pixels < (CAMERA.width, CAMERA.height)).all(axis=1)
    rows = np.flatnonzero(visible)
    rows = rows[rng.random(len(rows)) > 0.3][:limit]
    pixels = pixels[rows] + rng.normal(scale=noise, size=(len(rows), 2))
    descriptors = world.descriptors[rows] + rng.normal(scale=0.04, size=(len(rows), world.descriptors.shape[1]))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    return Features(pixels.astype(np.float32), descriptors.astype(np.float32), rng.random(len(rows)).astype(np.float32))


def nothing_to_see(seed: int, count: int = 200) -> Features:
    """Features that match nothing, as in a black or blurred frame full of noise."""
    rng = np.random.default_rng(seed)
    descriptors = rng.normal(size=(count, 32))
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    keypoints = rng.uniform((0, 0), (CAMERA.width, CAMERA.height), (count, 2))
    return Features(keypoints.astype(np.float32), descriptors.astype(np.float32), np.ones(count, np.float32))


def wall(count: int = 1500, seed: int = 0, depth: float = 3.0, tilt: float = 0.2) -> World:
    """Points on one tilted plane in front of a camera at the origin."""
    rng = np.random.default_rng(seed)
    points = np.empty((count, 3))
    points[:, :2] = rng.uniform(-1.0, 1.0, (count, 2)) * (1.5 * depth, 1.2 * depth)
    points[:, 2] = depth + tilt * points[:, 0] + 0.5 * tilt * points[:, 1]
    descriptors = rng.normal(size=(count, 32))
    return World(points, descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True))


def views_of(features: list[Features], first: int = 0) -> list[View]:
    """Consecutive views with connect-the-dots tracks, without poses and points, as the odometry makes them."""
    chain, views = TrackChain(), []
    for i, each in enumerate(features):
        descriptors = unit_descriptors(each)
        if views:
            matches = match_units(views[-1].descriptors, descriptors, 0.7)
            tracks = chain.extend(views[-1].tracks, matches, len(each))
        else:
            tracks = chain.start(len(each))
        views.append(
            View(
                frame_index=first + i,
                time=(first + i) / 30.0,
                keypoints=each.keypoints.astype(np.float64),
                descriptors=descriptors,
                weights=each.weights().astype(np.float64),
                tracks=tracks,
                points=np.full(len(each), -1, np.int64),
            )
        )
    return views


def error_percent(estimate: Float64, truth: Float64) -> float:
    """Root mean square distance of camera centers (N, 3) after alignment with scale, as % of the path."""
    aligned = align_points(truth, estimate, with_scale=True).apply(estimate)
    path = np.linalg.norm(np.diff(truth, axis=0), axis=1).sum()
    return float(100.0 * np.sqrt(((aligned - truth) ** 2).sum(axis=1).mean()) / path)
