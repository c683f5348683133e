"""What `benchmarks/robustness.py` tracks: clips, which are pictures with the true pose of each, and their sources.

A room is rendered once: the frames that three strides of its video need, in one compressed file of the cache. Several
processes may render at once, since a file appears whole or not at all, and the same seed gives the same pictures.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from improvo.errors import ConfigError
from improvo.evaluation.truth.referenced import open_with_truth
from improvo.files import written_atomically
from improvo.geometry.camera import Camera
from improvo.sequences import SequenceSettings, open_sequence
from improvo.simulation import bundled_sequence
from improvo.simulation.flow import image_motion
from improvo.simulation.renderer import SceneRenderer, camera_of
from improvo.simulation.scene import Scene, build_scene
from improvo.simulation.sensor import Sensor
from improvo.simulation.settings import SimulationSettings, preset
from improvo.types import Float64, Mask, UInt8

DATA = Path(__file__).parents[2] / "shared" / "data"
FPS, WIDTH, HEIGHT = 30.0, 320, 240
FRAMES_OF_STRIDE = {1: 100, 3: 90, 10: 60}
VIDEO = max(stride * frames for stride, frames in FRAMES_OF_STRIDE.items())  # frames of the whole video
PRESETS = ("easy", "home", "crowded")
VARIANTS: dict[str, dict[str, Any]] = {
    "plain": {},
    "turns": {"turn": 75.0},
    "walking": {"speed": 1.0, "walking_bob": 0.03, "hand_jitter": 2.0},
    "walls": {"room_size": (3.5, 4.2), "furniture": 3},
    "crowd": {"walkers": 4, "balls": 3, "room_size": (7.0, 8.0), "furniture": 4},
    "wide": {"fov": 100.0},
    "narrow": {"fov": 36.0},
}
MOTIONS = ("turning", "standing", "turning-midway", "standing-midway")  # the camera does not move, or not throughout
MIDWAY = slice(30, 70)  # frames of the clip during which it then does not move
_TRIES = 20  # seeds, where a room is too full to walk in
_INSTANT = 1e-3  # seconds over which image motion is taken


@dataclass(frozen=True)
class Clip:
    """Pictures in order, and the truth about each."""

    images: UInt8  # (N, H, W)
    times: Float64  # (N,) seconds, increasing
    camera: Camera
    world_from_cam: Float64  # (N, 4, 4), NaN where it is not known
    trackable: Mask  # (N,) whether a picture can have a pose at all; a black one cannot

    def __len__(self) -> int:
        return len(self.images)

    def take(self, rows: Any) -> Clip:
        """The pictures of these rows in that order, at the times of the first so many."""
        times = self.times[: len(self.times[rows])]
        return replace(
            self,
            images=self.images[rows],
            times=times,
            world_from_cam=self.world_from_cam[rows],
            trackable=self.trackable[rows],
        )


def real_clip(name: str, first: int, frames: int, width: int) -> Clip:
    """A stretch of a real recording, or of the bundled room, with its best truth.

    Args:
        name: `bundled`, or a folder of the real recordings.
        first: frame.
        frames: at most so many.
        width: pixels of the pictures; larger ones are made smaller.
    """
    settings = SequenceSettings(start=first, max_frames=frames)
    folder = bundled_sequence() if name == "bundled" else DATA / name
    plain = open_sequence(folder, settings)
    if plain.camera.width > width:
        settings = replace(settings, width=width)
    better = folder / "truth-sfm.txt"
    sequence = open_sequence(folder, settings)
    judged = open_with_truth(folder, settings, better) if better.is_file() else sequence
    truth = judged.ground_truth
    assert truth is not None
    images = np.stack([frame.image for frame in sequence])
    return Clip(images, sequence.times, sequence.camera, truth.world_from_cam, np.ones(len(images), bool))


def room_clip(cache: Path, preset_name: str, variant: str, seed: int, stride: int) -> Clip:
    """A stretch of a simulated room at 30, 10 or 3 frames a second.

    Args:
        cache: folder of rendered rooms.
        preset_name: of the simulation.
        variant: one of `VARIANTS`.
        seed: of everything.
        stride: one of `FRAMES_OF_STRIDE`.
    """
    settings = replace(preset(preset_name, **VARIANTS[variant]), **_size(VIDEO))
    wanted = {step * row for step, frames in FRAMES_OF_STRIDE.items() for row in range(frames)}
    stored = _rendered(cache / f"{preset_name}-{variant}-{seed}.npz", settings, seed, np.array(sorted(wanted)), "")
    rows = np.searchsorted(stored["frame"], stride * np.arange(FRAMES_OF_STRIDE[stride]))
    return _clip(stored, rows, settings)


def motion_clip(cache: Path, motion: str, seed: int) -> Clip:
    """A camera in a furnished room that does not move, or not all the time.

    Args:
        cache: folder of rendered rooms.
        motion: one of `MOTIONS`.
        seed: of everything.
    """
    frames = FRAMES_OF_STRIDE[1]
    settings = replace(preset("home", walkers=0, turn=40.0), **_size(frames))
    stored = _rendered(cache / f"{motion}-{seed}.npz", settings, seed, np.arange(frames), motion)
    return _clip(stored, np.arange(frames), settings)


def _size(frames: int) -> dict[str, Any]:
    return {"frames": frames, "fps": FPS, "width": WIDTH, "height": HEIGHT, "blur_samples": 3}


def _clip(stored: dict[str, Any], rows: Any, settings: SimulationSettings) -> Clip:
    camera = camera_of(settings.width, settings.height, settings.fov)
    times = stored["frame"][rows] / settings.fps
    return Clip(stored["images"][rows], times, camera, stored["world_from_cam"][rows], np.ones(len(rows), bool))


def _rendered(path: Path, settings: SimulationSettings, seed: int, frames: Any, motion: str) -> dict[str, Any]:
    """The arrays of the cache file, which is made where it is missing or damaged."""
    try:
        with np.load(path) as stored:
            return dict(stored)
    except (FileNotFoundError, ValueError, EOFError, zipfile.BadZipFile):
        pass
    settings, scene = _scene(settings, seed)
    images, poses = _render(settings, scene, frames, motion)
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {"frame": frames, "images": images, "world_from_cam": poses}
    with written_atomically(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)
    return arrays


def _scene(settings: SimulationSettings, seed: int) -> tuple[SimulationSettings, Scene]:
    """The world of a seed; of a later one, where the room is too full to walk in."""
    for attempt in range(_TRIES):
        attempted = replace(settings, seed=seed + 10_000 * attempt)
        try:
            return attempted, build_scene(attempted)
        except ConfigError:
            continue
    raise ConfigError(f"seed {seed}: no room to walk in {_TRIES} tries")


def _render(settings: SimulationSettings, scene: Scene, frames: Any, motion: str) -> tuple[UInt8, Float64]:
    """Grey pictures (N, H, W) and poses (N, 4, 4) of some frames of a video, as its sensor delivers them."""
    camera, sensor = camera_of(settings.width, settings.height, settings.fov), Sensor(settings)
    times = frames / settings.fps
    poses = _moved(scene, times, motion)
    poses_after = _moved(scene, times + _INSTANT, motion)
    images = np.empty((len(frames), settings.height, settings.width), np.uint8)
    with SceneRenderer(scene, camera) as renderer:
        for row, (frame, time) in enumerate(zip(frames.tolist(), times.tolist(), strict=True)):
            perfect = renderer.image(time, poses[row], shadows=False)  # cast shadows take most of the time
            depth, geom = renderer.geometry(time, poses[row])
            geoms = (renderer.geom_poses(time), renderer.geom_poses(time + _INSTANT))
            motions = (poses[row], poses_after[row])
            flow = image_motion(camera, depth, geom, motions, geoms, renderer.moving) / _INSTANT
            exposed = sensor.expose(perfect, flow, frame, time)
            grey = exposed @ np.array([0.299, 0.587, 0.114])
            images[row] = np.rint(grey).astype(np.uint8)
    return images, poses


def _moved(scene: Scene, times: Float64, motion: str) -> Float64:
    """Poses (N, 4, 4) along the scene's path, held as `motion` says."""
    poses = scene.camera.world_from_cam(times)
    if motion == "":
        return poses
    held = MIDWAY if motion.endswith("midway") else slice(0, len(times))
    first = held.start
    if motion.startswith("standing"):
        poses[held] = poses[first]
    else:
        poses[held, :3, 3] = poses[first, :3, 3]
    # the walk goes on from where it was interrupted
    if held.stop < len(times):
        rest = scene.camera.world_from_cam(times[first : first + len(times) - held.stop])
        if motion.startswith("standing"):
            poses[held.stop :] = rest
        else:
            poses[held.stop :, :3, 3] = rest[:, :3, 3]
    return poses
