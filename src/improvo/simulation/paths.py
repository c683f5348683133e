"""Smooth paths over the floor, and the path of a hand-held camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from improvo.errors import ConfigError, imported
from improvo.geometry.alignment import path_lengths
from improvo.geometry.se3 import rigid, so3_exp
from improvo.simulation.room import Floor
from improvo.simulation.settings import SimulationSettings
from improvo.types import Float64

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

interpolate = imported("scipy.interpolate", "simulate", "simulate")


@dataclass(frozen=True)
class FloorPath:
    """A closed way over the floor, walked at constant speed."""

    spline: CubicSpline  # arc length -> (2,)
    length: float
    speed: float
    start: float  # arc length at time 0

    def position(self, time: Float64 | float) -> Float64:
        """(..., 2)."""
        return np.asarray(self.spline((self.start + self.speed * np.asarray(time)) % self.length))

    def heading(self, time: Float64 | float) -> Float64:
        """Direction of walking (...) in radians."""
        tangent = self.spline((self.start + self.speed * np.asarray(time)) % self.length, 1)
        return np.arctan2(tangent[..., 1], tangent[..., 0])


def floor_path(rng: np.random.Generator, floor: Floor, clearance: float, speed: float) -> FloorPath:
    """A closed smooth path that stays away from walls and furniture.

    Raises:
        ConfigError: the room is too full for one.
    """
    half = np.array([floor.width, floor.length]) / 2
    angles = np.linspace(0, 2 * np.pi, 97)
    tries, waves = 500, np.arange(1, 4)
    size, phase = rng.uniform(0, 0.2, (tries, 1, 3)), rng.uniform(0, 2 * np.pi, (tries, 1, 3))
    wobble = 1 + (size * np.cos(angles[:, None] * waves + phase)).sum(axis=2)
    loops = np.stack([wobble * np.cos(angles), wobble * np.sin(angles)], axis=-1)
    loops *= (rng.uniform(0.15, 0.75, (tries, 2)) * half)[:, None]
    loops += (rng.uniform(-0.6, 0.6, (tries, 2)) * half)[:, None]
    lengths = np.linalg.norm(np.diff(loops, axis=1), axis=2).sum(axis=1)
    least = np.minimum(floor.clearance(loops).min(axis=1), clearance)
    best = int(np.lexsort((lengths, least))[-1])  # room to walk first, then the longest
    if least[best] < 0.08:
        raise ConfigError("the room is too full for a path; use fewer pieces of `furniture` or a larger `room_size`")
    dense = loops[best][:: -1 if rng.uniform() < 0.5 else 1].copy()
    steps = path_lengths(dense)
    dense[-1] = dense[0]
    spline = interpolate.CubicSpline(steps, dense, bc_type="periodic")
    return FloorPath(spline, float(steps[-1]), speed, float(rng.uniform(0, steps[-1])))


class CameraPath:
    """Camera poses at any time: a walk, looking around, steps, and an unsteady hand."""

    def __init__(self, rng: np.random.Generator, floor: Floor, settings: SimulationSettings) -> None:
        self._settings = settings
        self.path = floor_path(rng, floor, 0.4, settings.speed)
        duration = settings.frames / settings.fps
        self._height = float(rng.uniform(1.35, 1.6))
        knots = np.arange(-3.0, duration + 6.0, 2.5)
        self._yaw = interpolate.PchipInterpolator(knots, self._look_around(rng, floor, knots))
        self._pitch = interpolate.PchipInterpolator(knots, np.radians(rng.uniform(-28, -4, len(knots))))
        self._roll = interpolate.PchipInterpolator(knots, np.radians(rng.normal(0, 1.5, len(knots))))
        self._pace = settings.speed / 0.35 * 1.5  # steps per second
        self._hand = _Tremor(rng, 3, (0.4, 2.0), 0.003 * settings.hand_jitter)
        self._shake = _Tremor(rng, 3, (0.5, 5.0), np.radians(0.3) * settings.hand_jitter)

    def world_from_cam(self, times: Float64) -> Float64:
        """(N, 4, 4) at times (N,); the camera looks along z with y down, the world has z up."""
        times = np.asarray(times, np.float64)
        bob = self._settings.walking_bob
        heading = self.path.heading(times)
        sway = 0.6 * bob * np.sin(np.pi * self._pace * times)
        position = np.column_stack([self.path.position(times), np.full(len(times), self._height)])
        position[:, 0] -= sway * np.sin(heading)
        position[:, 1] += sway * np.cos(heading)
        position[:, 2] += bob * np.sin(2 * np.pi * self._pace * times)
        position += self._hand(times)
        yaw, pitch, roll = self._yaw(times), self._pitch(times), self._roll(times)
        forward = np.column_stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)])
        right = np.column_stack([np.sin(yaw), -np.cos(yaw), np.zeros(len(times))])
        down = np.cross(forward, right)
        level = np.stack([right, down, forward], axis=-1)
        turn = self._shake(times)
        turn[:, 2] += roll
        return rigid(level @ so3_exp(turn), position)

    def _look_around(self, rng: np.random.Generator, floor: Floor, knots: Float64) -> Float64:
        """Yaw at the knots: each looks across the room, turned no further than the settings allow."""
        most = np.radians(self._settings.turn) * 2.5
        yaw = [float(np.arctan2(*-self.path.position(float(knots[0]))[::-1]))]
        half = np.array([floor.width, floor.length]) / 2
        for time in knots[1:]:
            here = self.path.position(float(time))
            candidates = yaw[-1] + rng.uniform(-most, most, 12)
            rays = np.column_stack([np.cos(candidates), np.sin(candidates)])
            with np.errstate(divide="ignore"):
                distance = ((half * np.sign(rays) - here) / rays).min(axis=1)
            suited = np.abs(distance - 3.3) + 0.4 * np.abs(candidates - yaw[-1])
            yaw.append(float(candidates[suited.argmin()]))
        return np.asarray(yaw)


class _Tremor:
    """A random smooth motion: a sum of sines, slow ones larger."""

    def __init__(self, rng: np.random.Generator, axes: int, band: tuple[float, float], size: float) -> None:
        count = 8
        self._frequency = np.exp(rng.uniform(np.log(band[0]), np.log(band[1]), (count, axes)))
        self._phase = rng.uniform(0, 2 * np.pi, (count, axes))
        amplitude = rng.uniform(0.5, 1.0, (count, axes)) / self._frequency
        self._amplitude = size * np.sqrt(2) * amplitude / np.linalg.norm(amplitude, axis=0)

    def __call__(self, times: Float64) -> Float64:
        angle = 2 * np.pi * self._frequency * np.asarray(times)[:, None, None] + self._phase
        return np.asarray((self._amplitude * np.sin(angle)).sum(axis=1))
