"""A scene with known truth for tests of the evaluation: points on a slanted plane, seen by a moving camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from improvo.geometry.camera import Camera
from improvo.geometry.se3 import inverse, rigid, so3_exp, transform
from improvo.types import Features, Float32, Float64, Frame, Trajectory

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
NORMAL, OFFSET = np.array([-0.3, 0.1, 1.0]), 2.0  # plane: NORMAL . X = OFFSET


@dataclass
class PlaneSequence:
    """Looks like `improvo.sequences.Sequence`."""

    frames: int = 20
    name: str = "plane"
    depth_every: int = 1  # 0: no depth
    with_truth: bool = True
    unreadable: tuple[int, ...] = ()

    @property
    def path(self) -> Path:
        return Path("/scenes") / self.name

    @property
    def camera(self) -> Camera:
        return CAMERA

    @cached_property
    def times(self) -> Float64:
        return np.arange(self.frames) / 30.0

    @cached_property
    def poses(self) -> Float64:
        step = np.arange(self.frames)[:, None]
        turn = step * np.radians([0.2, -0.4, 0.1])
        return rigid(so3_exp(turn), step * np.array([0.02, 0.005, 0.01]))

    @property
    def ground_truth(self) -> Trajectory | None:
        return Trajectory(self.times, self.poses.copy()) if self.with_truth else None

    def __len__(self) -> int:
        return self.frames

    def __getitem__(self, i: int) -> Frame:
        if i in self.unreadable:
            from improvo.errors import InputError

            raise InputError(f"frame {i}: cannot be decoded")
        image = np.random.default_rng(i).integers(0, 255, (CAMERA.height, CAMERA.width)).astype(np.uint8)
        return Frame(i, float(self.times[i]), image, f"/scenes/{self.name}/{i:06d}.png")

    def depth(self, i: int) -> Float32 | None:
        if self.depth_every == 0 or i % self.depth_every:
            return None
        columns, rows = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
        rays = CAMERA.unproject(np.stack([columns, rows], axis=-1).astype(np.float64))
        normal = NORMAL @ self.poses[i, :3, :3]
        offset = OFFSET - NORMAL @ self.poses[i, :3, 3]
        return (offset / (rays @ normal)).astype(np.float32)

    @cached_property
    def points(self) -> Float64:
        """World points (P, 3) on the plane."""
        rng = np.random.default_rng(0)
        xy = rng.uniform([-1.6, -1.2], [2.2, 1.4], (400, 2))
        return np.column_stack([xy, (OFFSET - xy @ NORMAL[:2]) / NORMAL[2]])


@dataclass(frozen=True)
class PlaneSource:
    """Opens the sequence, in any process."""

    frames: int = 20
    name: str = "plane"
    depth_every: int = 1  # 0: no depth
    with_truth: bool = True
    unreadable: tuple[int, ...] = ()

    @property
    def path(self) -> str:
        return f"/scenes/{self.name}"

    def open(self) -> Any:
        return PlaneSequence(self.frames, self.name, self.depth_every, self.with_truth, self.unreadable)


@dataclass(frozen=True)
class PlaneFeatures:
    """A frontend that sees the true points; what it gets wrong is chosen."""

    label: str = "perfect"
    noise: float = 0.0  # pixels
    shuffled: bool = False  # descriptors handed to the wrong points
    blind: bool = False  # finds nothing
    max_keypoints: int = 500
    log: str = ""  # file that counts calls

    def fingerprint(self) -> dict[str, Any]:
        return {"noise": self.noise, "shuffled": self.shuffled, "max_keypoints": self.max_keypoints}

    def features(self, sequence: Any, frame: Frame) -> Features:
        if self.log:
            with Path(self.log).open("a") as file:
                file.write(f"{frame.source_index}\n")
        pose = inverse(sequence.poses[frame.source_index])
        points = transform(pose, sequence.points)
        pixels = CAMERA.project(points)
        inside = (points[:, 2] > 0.1) & (pixels >= 0).all(axis=1) & (pixels <= [159, 119]).all(axis=1)
        ids = np.zeros(0, np.int64) if self.blind else np.flatnonzero(inside)[: self.max_keypoints]
        rng = np.random.default_rng(frame.source_index)
        descriptors = np.random.default_rng(1).normal(size=(len(sequence.points), 32)).astype(np.float32)
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        given = rng.permutation(ids) if self.shuffled else ids
        keypoints = pixels[ids] + rng.normal(0, 1, (len(ids), 2)) * self.noise
        return Features(keypoints.astype(np.float32), descriptors[given], np.linspace(1, 0, len(ids), dtype=np.float32))
