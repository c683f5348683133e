"""Render simulated recordings: a folder in TUM RGB-D layout with the cause of instability of every pixel."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from improvo.config import to_dict
from improvo.files import write_json, written_atomically
from improvo.folder_lock import working_in
from improvo.geometry.camera import Camera
from improvo.jobs.pool import Workers
from improvo.simulation.causes import Cause, cause_image
from improvo.simulation.flow import image_motion
from improvo.simulation.renderer import SceneRenderer, camera_of
from improvo.simulation.scene import build_scene
from improvo.simulation.sensor import Sensor
from improvo.simulation.settings import SimulationSettings
from improvo.simulation.tum_writer import TumRgbdWriter
from improvo.types import Float32, Float64, UInt8

_INSTANT = 1e-3  # seconds over which image motion is taken


@dataclass(frozen=True)
class SimulatedFrame:
    """One frame with its whole truth."""

    time: float
    image: UInt8  # (H, W, 3) BGR, or (H, W) where colour is off
    depth: Float32  # (H, W) metres
    world_from_cam: Float64  # (4, 4)
    causes: UInt8  # (H, W), see `Cause`


def simulated_frames(settings: SimulationSettings) -> Iterator[SimulatedFrame]:
    """Render the frames of one recording, one after the other.

    Raises:
        MissingExtraError: the renderer is not installed.
        ConfigError: the room is too full to walk in.
    """
    scene = build_scene(settings)
    camera = camera_of(settings.width, settings.height, settings.fov)
    times = np.arange(settings.frames) / settings.fps
    poses = scene.camera.world_from_cam(times)
    poses_after = scene.camera.world_from_cam(times + _INSTANT)
    sensor = Sensor(settings)
    with SceneRenderer(scene, camera) as renderer:
        for frame, time in enumerate(times.tolist()):
            perfect = renderer.image(time, poses[frame])
            depth, geom = renderer.geometry(time, poses[frame])
            geoms = (renderer.geom_poses(time), renderer.geom_poses(time + _INSTANT))
            motion = image_motion(camera, depth, geom, (poses[frame], poses_after[frame]), geoms, renderer.moving)
            image = sensor.expose(perfect, motion / _INSTANT, frame, time)
            if settings.colour:
                image = np.ascontiguousarray(image[..., ::-1])
            causes = cause_image(renderer, time, poses[frame], perfect, depth, geom)
            yield SimulatedFrame(time, image, depth, poses[frame], causes)


def simulate(
    settings: SimulationSettings,
    folder: Path,
    jpeg_quality: int | None = None,
    depth_every: int = 1,
    progress: Callable[[], object] = lambda: None,
) -> None:
    """Render one recording into a folder.

    Args:
        folder: made; see docs/simulation.md for what lies in it.
        jpeg_quality: write JPEG instead of PNG images.
        depth_every: write the depth of every n-th frame only.
        progress: called after every frame.

    Raises:
        OutputError: the folder holds something else, cannot be written, or another process is at work there.
    """
    with working_in(folder, "simulate"):
        (folder / "labels").mkdir(exist_ok=True)
        camera: Camera = camera_of(settings.width, settings.height, settings.fov)
        about = {
            "settings": to_dict(settings),
            "causes": {cause.name.lower(): int(cause) for cause in Cause},
            "labels": "labels/NNNNNN.png, the cause of instability per pixel, named like the images",
        }
        write_json(folder / "simulation.json", about)
        with TumRgbdWriter(folder, camera, settings.fps, jpeg_quality=jpeg_quality) as writer:
            for number, frame in enumerate(simulated_frames(settings)):
                _write_labels(folder / "labels" / f"{number:06d}.png", frame.causes)
                depth = frame.depth if number % depth_every == 0 else None
                writer.add(frame.time, frame.image, depth, frame.world_from_cam)
                progress()


def simulate_many(
    settings: SimulationSettings,
    folder: Path,
    scenes: int,
    workers: int,
    jpeg_quality: int | None = None,
    depth_every: int = 1,
    progress: Callable[[], object] = lambda: None,
) -> list[Path]:
    """Render recordings with the seeds `settings.seed`, +1, ... into `folder/scene-SEED`, by `workers` processes.

    Returns:
        Their folders. `progress` is called after every recording.
    """
    jobs = [replace(settings, seed=settings.seed + number) for number in range(scenes)]
    targets = [folder / f"scene-{job.seed:04d}" for job in jobs]
    tasks = [(job, target, jpeg_quality, depth_every) for job, target in zip(jobs, targets, strict=True)]
    with working_in(folder, "simulate"), Workers(workers) as pool:
        for _ in pool.run(_simulate_alone, tasks, "simulate"):
            progress()
    return targets


def _simulate_alone(task: tuple[SimulationSettings, Path, int | None, int]) -> None:
    os.environ["LP_NUM_THREADS"] = "1"  # the software rasteriser's threads
    simulate(*task)


def _write_labels(path: Path, causes: UInt8) -> None:
    with written_atomically(path) as temporary:
        temporary.write_bytes(cv2.imencode(".png", causes, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes())
