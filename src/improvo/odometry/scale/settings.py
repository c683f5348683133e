"""From what the size of a run is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from improvo.errors import ConfigError

Source = Literal["none", "depth", "truth", "distance", "height", "marker"]
USAGE = "depth | truth [FILE] | distance A B METRES | height METRES | marker METRES"


@dataclass(frozen=True)
class ScaleSettings:
    """What gives the metres of a run; without it, poses and map are up to scale.

    Raises:
        ConfigError: a source without its numbers, or impossible ones.
    """

    source: Source = "none"  # depth, truth, distance, height, marker; none leaves the run up to scale
    metres: float | None = None  # of a distance, of the camera's height over the ground, or of a marker's side
    frames: tuple[int, int] | None = None  # between which the distance lies, numbers in the recording
    reference: str | None = None  # trajectory in metres for `truth`; None is the recording's own
    marker_dictionary: str = "auto"  # of OpenCV, such as DICT_4X4_50 or DICT_APRILTAG_36h11

    def __post_init__(self) -> None:
        if self.source not in ("none", "depth", "truth", "distance", "height", "marker"):
            raise ConfigError(f"--scale {self.source}: unknown; give {USAGE}")
        if self.source in ("distance", "height", "marker") and self.metres is None:
            raise ConfigError(f"--scale {self.source}: needs METRES; give {USAGE}")
        if self.metres is not None and not 0 < self.metres < 1e6:
            raise ConfigError(
                f"--scale {self.source}: {self.metres:g} m is no length; give a positive number of metres"
            )
        if (self.source == "distance") != (self.frames is not None):
            raise ConfigError(f"--scale {self.source}: two frames belong to `distance` alone; give {USAGE}")
        if self.frames is not None and (min(self.frames) < 0 or self.frames[0] == self.frames[1]):
            raise ConfigError(f"--scale distance: frames {self.frames[0]} and {self.frames[1]} are no two places")


def scale_settings(words: Sequence[str]) -> list[str]:
    """What is written after `--scale`, as `name=value` settings.

    Raises:
        ConfigError: other words than a source and its numbers.
    """
    source, *rest = words
    counts = {"depth": (0,), "truth": (0, 1), "distance": (3,), "height": (1,), "marker": (1,)}
    if source not in counts or len(rest) not in counts[source]:
        raise ConfigError(f"--scale {' '.join(words)}: give {USAGE}")
    found = [f"scale.source={source}"]
    if source == "truth":
        return found + [f"scale.reference={file!r}" for file in rest]
    try:
        if source == "distance":
            found.append(f"scale.frames=[{int(rest[0])}, {int(rest[1])}]")
        if rest:
            found.append(f"scale.metres={float(rest[-1])!r}")
    except ValueError:
        raise ConfigError(f"--scale {' '.join(words)}: not numbers; give {USAGE}") from None
    return found
