"""Settings of a simulated recording: one dataclass, and the presets `easy`, `home` and `crowded`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from improvo.config import check_seed
from improvo.errors import ConfigError

_FROM_ZERO = (
    *("furniture", "clutter", "posters", "walkers", "balls", "plain_share", "repeated_share", "gloss", "vignetting"),
    *("speed", "turn", "hand_jitter", "walking_bob", "brightness", "noise", "exposure_time", "exposure_drift"),
    "rolling_shutter",
)


@dataclass(frozen=True)
class SimulationSettings:
    """One simulated recording; lengths in metres, angles in degrees, times in seconds."""

    frames: int = 300
    fps: float = 30.0
    width: int = 640
    height: int = 480
    fov: float = 62.0  # horizontal field of view
    seed: int = 0  # room, path, movers and noise all follow from it

    # the room
    room_size: tuple[float, float] = (5.2, 6.8)  # shortest and longest wall
    room_height: float = 2.6
    furniture: int = 6  # pieces along the walls
    clutter: int = 24  # small things on tables and shelves
    posters: int = 8
    plain_share: float = 0.25  # share of surfaces without texture
    repeated_share: float = 0.25  # share of surfaces with a repeated texture
    gloss: float = 0.3  # share of glossy surfaces

    # what moves
    walkers: int = 1
    balls: int = 0
    swinging_lamp: bool = True  # carries a light, so its shadows move
    drawer: bool = True

    # the hand that holds the camera
    speed: float = 0.35  # metres per second along the path
    turn: float = 25.0  # degrees per second from one look to the next, at most; half as much again on the way
    hand_jitter: float = 1.0  # 1 is an ordinary hand: 3 mm along and 0.3 degrees about each axis, standard deviation
    walking_bob: float = 0.012  # by which a step lifts and lowers the camera

    # light and sensor
    brightness: float = 1.0
    noise: float = 2.0  # grey levels, standard deviation at mid grey
    vignetting: float = 0.25  # darkening of the corners
    exposure_time: float = 0.008
    exposure_drift: float = 0.12  # largest relative change of exposure
    rolling_shutter: float = 0.0  # read-out time of a frame; 0 is a global shutter
    blur_samples: int = 5  # images averaged over the exposure
    colour: bool = True  # False writes grey images

    def __post_init__(self) -> None:
        least = {"frames": 2, "width": 64, "height": 48, "blur_samples": 1, **dict.fromkeys(_FROM_ZERO, 0)}
        for name, minimum in least.items():
            if not getattr(self, name) >= minimum:
                raise ConfigError(f"setting `{name}`: {getattr(self, name)} is too small; at least {minimum}")
        if not (self.fps > 0 and 20 <= self.fov <= 120):
            raise ConfigError(
                f"settings `fps` {self.fps} and `fov` {self.fov}: fps above 0, fov from 20 to 120 degrees"
            )
        for name in ("plain_share", "repeated_share", "gloss", "vignetting"):
            if not getattr(self, name) <= 1:
                raise ConfigError(f"setting `{name}`: {getattr(self, name)} is a share between 0 and 1")
        if self.plain_share + self.repeated_share > 1:
            raise ConfigError("settings `plain_share` and `repeated_share`: must not be more than 1 together")
        if not 2.3 <= self.room_height <= 6:
            raise ConfigError(f"setting `room_height`: {self.room_height} must lie between 2.3 and 6 metres")
        if not 3.5 <= min(self.room_size) <= max(self.room_size) <= 12:
            raise ConfigError(f"setting `room_size`: {self.room_size} must lie between 3.5 and 12 metres")
        check_seed(self.seed)


_PRESETS: dict[str, dict[str, Any]] = {
    "easy": {
        "walkers": 0,
        "swinging_lamp": False,
        "drawer": False,
        "plain_share": 0.05,
        "repeated_share": 0.1,
        "gloss": 0.0,
        "posters": 12,
        "speed": 0.25,
        "hand_jitter": 0.5,
        "noise": 1.0,
        "exposure_drift": 0.03,
        "exposure_time": 0.003,
    },
    "home": {},
    "crowded": {
        "walkers": 3,
        "balls": 2,
        "gloss": 0.6,
        "furniture": 7,
        "clutter": 36,
        "repeated_share": 0.35,
        "exposure_time": 0.012,
        "exposure_drift": 0.2,
        "noise": 3.0,
    },
}
PRESETS = tuple(_PRESETS)


def preset(name: str, **changes: Any) -> SimulationSettings:
    """The settings of a preset, with changes.

    Raises:
        ConfigError: there is no such preset.
    """
    if name not in _PRESETS:
        raise ConfigError(f"preset `{name}` is unknown; choose one of {', '.join(PRESETS)}")
    return replace(SimulationSettings(), **(_PRESETS[name] | changes))
