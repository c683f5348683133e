"""Simulated windows with known truth: for tests, benchmarks, and to compile the kernels on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from improvo.backend.problem import BundleProblem
from improvo.geometry import se3
from improvo.types import Float64

K = np.array([[525.0, 0.0, 319.5], [0.0, 525.0, 239.5], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Window:
    """A problem, perturbed from its truth."""

    problem: BundleProblem
    cam_from_world: Float64  # (N, 4, 4) true poses
    points: Float64  # (M, 3) true points


def simulated_window(
    seed: int = 0,
    cameras: int = 12,
    fixed: int = 2,
    points: int = 60,
    noise: float = 0.5,
    outliers: float = 0.0,
    pose_error: float = 0.01,
    point_error: float = 0.05,
    mean_track: float = 11.0,
) -> Window:
    """A camera that moves sideways and turns a little before a cloud of points; each point is seen for some frames.

    Args:
        noise: pixels.
        outliers: share of observations off by 20 px.
        pose_error, point_error: of the start, in radians and map units.
        mean_track: mean length of a track in frames.
    """
    rng = np.random.default_rng(seed)
    time = np.linspace(0.0, cameras / 60, cameras)
    centres = np.stack([2 * time, 0.1 * np.sin(6 * time), 0.1 * time], axis=1)
    turns = np.stack([0.05 * np.sin(5 * time), 0.15 * np.sin(3 * time), 0.02 * time], axis=1)
    cam_from_world = se3.inverse(se3.rigid(se3.so3_exp(turns), centres))
    xyz: list[Float64] = []
    camera_index, point_index, keypoints = [], [], []
    while len(xyz) < points:
        candidate = rng.uniform((-3.0, -2.0, 1.5), (5.0, 2.0, 4.5))
        in_camera = se3.transform(cam_from_world, candidate[None])[:, 0]
        pixels = in_camera[:, :2] / in_camera[:, 2:] * 525.0 + K[:2, 2]
        visible = np.flatnonzero(((pixels > 0) & (pixels < (640, 480))).all(axis=1))
        if len(visible) < 3:
            continue
        start = rng.choice(visible)
        seen = visible[(visible >= start) & (visible < start + max(3, int(rng.exponential(mean_track))))]
        if len(seen) < 3:
            continue
        camera_index.append(seen)
        point_index.append(np.full(len(seen), len(xyz)))
        keypoints.append(pixels[seen])
        xyz.append(candidate)
    keypoints_all = np.concatenate(keypoints)
    keypoints_all += rng.normal(0.0, noise, keypoints_all.shape)
    wrong = rng.random(len(keypoints_all)) < outliers
    keypoints_all[wrong] += rng.normal(0.0, 20.0, (wrong.sum(), 2))

    is_fixed = np.arange(cameras) < fixed
    jitter = se3.rigid(
        se3.so3_exp(rng.normal(0.0, pose_error, (cameras, 3))), rng.normal(0.0, pose_error, (cameras, 3))
    )
    start_poses = np.where(is_fixed[:, None, None], cam_from_world, jitter @ cam_from_world)
    truth = np.array(xyz)
    problem = BundleProblem(
        cam_from_world=start_poses,
        points=truth + rng.normal(0.0, point_error, truth.shape),
        camera_index=np.concatenate(camera_index),
        point_index=np.concatenate(point_index),
        keypoints=keypoints_all,
        weights=rng.uniform(0.3, 1.0, len(keypoints_all)),
        K=K,
        fixed_cameras=is_fixed,
    )
    return Window(problem, cam_from_world, truth)
