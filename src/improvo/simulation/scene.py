"""One simulated world: a room, what moves in it, its lights and the camera's path, all from one seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from improvo.errors import ConfigError
from improvo.simulation.builder import SceneBuilder
from improvo.simulation.furniture import Workshop
from improvo.simulation.movers import ball, drawer_motion, swinging_lamp, walker
from improvo.simulation.palette import Palette, pick
from improvo.simulation.paths import CameraPath, FloorPath, floor_path
from improvo.simulation.room import Floor, furnish
from improvo.simulation.settings import SimulationSettings

_TOO_NEAR = 1.4  # metres between the camera and a walker
_IN_VIEW = 0.4  # share of the time that a walker is in view


@dataclass(frozen=True)
class Scene:
    """A world ready to render."""

    builder: SceneBuilder
    camera: CameraPath
    floor: Floor


def build_scene(settings: SimulationSettings) -> Scene:
    """The world of these settings; the same settings give the same world."""
    room_seed, path_seed, mover_seed = np.random.SeedSequence(settings.seed).spawn(3)
    rng = np.random.default_rng(room_seed)
    builder = SceneBuilder(rng, settings.gloss)
    palette = Palette(builder, settings)
    mover_rng = np.random.default_rng(mover_seed)
    drawer = drawer_motion(mover_rng) if settings.drawer else None
    shop = Workshop(builder, palette, drawer)
    floor = furnish(shop, settings)
    camera = CameraPath(np.random.default_rng(path_seed), floor, settings)
    for _ in range(settings.walkers):
        walker(shop, _apart(mover_rng, floor, camera, settings, pick(mover_rng, (0.6, 1.1))))
    for _ in range(settings.balls):
        ball(shop, _apart(mover_rng, floor, camera, settings, pick(mover_rng, (0.5, 0.9))))
    _lights(shop, floor, settings)
    return Scene(builder, camera, floor)


def _apart(
    rng: np.random.Generator, floor: Floor, camera: CameraPath, settings: SimulationSettings, speed: float
) -> FloorPath:
    """A path on which a moving object keeps away from the camera, but is sometimes in view."""
    times = np.arange(0, settings.frames / settings.fps, 0.2)
    poses = camera.world_from_cam(times)
    here, forward = poses[:, :2, 3], poses[:, :2, 2]
    best: tuple[float, float, FloorPath] | None = None  # distance that counts, share of time in view, path
    for _ in range(6):
        path = floor_path(rng, floor, 0.3, speed)
        for _ in range(10):
            path = FloorPath(path.spline, path.length, speed, float(rng.uniform(0, path.length)))
            away = path.position(times) - here
            distance = np.linalg.norm(away, axis=1)
            seen = (away * forward).sum(axis=1) > np.cos(np.radians(settings.fov / 2)) * distance
            score = (min(float(distance.min()), _TOO_NEAR), min(float(seen.mean()), _IN_VIEW))
            if best is None or score > best[:2]:
                best = (*score, path)
        if best and best[:2] == (_TOO_NEAR, _IN_VIEW):
            break
    if best is None or best[0] < 0.6:
        raise ConfigError("no room for a walker beside the camera; use fewer `walkers`, fewer frames or another seed")
    return best[2]


def _lights(shop: Workshop, floor: Floor, settings: SimulationSettings) -> None:
    """A ceiling light with shadows, a soft one without, and the swinging lamp."""
    builder, rng, height = shop.builder, shop.builder.rng, settings.room_height
    x, y = pick(rng, (-0.2, 0.2)) * floor.width, pick(rng, (0.1, 0.3)) * floor.length * float(rng.choice([-1, 1]))
    glow = builder.material(None, colour=(1.0, 0.97, 0.9), emission=1.0, shine=0.0)
    builder.lathe(builder.world, [(0.0, -0.06), (0.16, -0.05), (0.18, 0.0)], (x, y, height), glow)
    builder.light(builder.world, (x, y, height - 0.1), (0, 0, -1), 0.55 * settings.brightness, shadow=True, cutoff=70)
    builder.light(builder.world, (-x, -y, 1.2), (0, 0, 1), 0.55 * settings.brightness, shadow=False, cutoff=180)
    builder.light(builder.world, (x, -y, 1.4), (0, 0, -1), 0.55 * settings.brightness, shadow=False, cutoff=180)
    if settings.swinging_lamp:
        swinging_lamp(shop, (-x, -y), height, 0.38 * settings.brightness)
