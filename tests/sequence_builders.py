"""Recordings on disk for the tests of `sequences`: a textured plane seen by a moving camera."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from improvo.geometry.camera import Camera
from improvo.geometry.se3 import rigid, so3_exp
from improvo.simulation.tum_writer import TumRgbdWriter
from improvo.types import Float64, UInt8

CAMERA = Camera(96, 72, 90.0, 91.0, 47.0, 36.5)


def texture(seed: int = 0, size: int = 400) -> UInt8:
    noise = np.random.default_rng(seed).integers(0, 256, (size, size)).astype(np.uint8)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX)


def images(count: int, camera: Camera = CAMERA) -> list[UInt8]:
    """Grey pictures (H, W) that all differ."""
    plane = texture(size=camera.width + camera.height + 4 * count + 10)
    return [
        np.ascontiguousarray(plane[2 * i : 2 * i + camera.height, 3 * i : 3 * i + camera.width]) for i in range(count)
    ]


def depths(count: int, camera: Camera = CAMERA) -> list[np.ndarray]:
    """Depth in whole millimetres (H, W), metres, with a hole."""
    rows = np.arange(camera.height)[:, None] + np.zeros(camera.width)
    result = []
    for i in range(count):
        depth = ((1000 + 5 * rows + 7 * i) / 1000).astype(np.float32)
        depth[:5, :7] = np.nan
        result.append(depth)
    return result


def poses(count: int) -> Float64:
    """(N, 4, 4) world_from_cam, first not the identity."""
    steps = np.arange(count, dtype=np.float64)[:, None]
    rotation = so3_exp(np.concatenate([0.02 * steps, 0.1 + 0.01 * steps, -0.03 * steps], axis=1))
    return rigid(rotation, np.concatenate([0.5 + 0.1 * steps, -0.05 * steps, 0.02 * steps**2], axis=1))


def write_images(folder: Path, pictures: list[UInt8], pattern: str = "{:06d}.png") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number, picture in enumerate(pictures):
        assert cv2.imwrite(str(folder / pattern.format(number)), picture)


def write_video(path: Path, pictures: list[UInt8], fps: float = 25.0, codec: str = "MJPG") -> None:
    height, width = pictures[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*codec), fps, (width, height))
    assert writer.isOpened()
    for picture in pictures:
        writer.write(picture if picture.ndim == 3 else cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR))
    writer.release()


def write_tum(folder: Path, count: int = 7) -> np.ndarray:
    times = 1341836537.5 + np.arange(count) / 30
    with TumRgbdWriter(folder, CAMERA, fps=30.0, depth_scale=1000.0) as writer:
        for time, image, depth, pose in zip(times, images(count), depths(count), poses(count), strict=True):
            writer.add(float(time), image, depth, pose)
    return times
