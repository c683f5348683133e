"""From what the size of a run is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from improvo.config import yaml_line
from improvo.errors import ConfigError

Source = Literal["none", "depth", "truth", "distance", "height", "marker"]
USAGE = "depth | truth [FILE [BEGAN]] | distance A B METRES | height METRES | marker METRES"
_SOURCES = ("none", "depth", "truth", "distance", "height", "marker")


@dataclass(frozen=True)
class ScaleSettings:
    """What gives the metres of a run; without it, poses and map are up to scale.

    Raises:
        ConfigError: a source without its numbers, or impossible ones.
    """

    source: Source = "none"  # depth, truth, distance, height, marker; none leaves the run up to scale
    metres: float | None = None  # of the camera's height over the ground, or of a marker's side
    distances: tuple[tuple[int, int, float], ...] = ()  # two frames, numbers in the recording, and the metres between
    reference: str | None = None  # trajectory or GPS track for `truth`; None is the recording's own poses
    began: str | None = None  # the time of the reference when the recording's clock was at 0: a date or seconds
    marker_dictionary: str = "auto"  # of OpenCV, such as DICT_4X4_50 or DICT_APRILTAG_36h11

    def __post_init__(self) -> None:
        if self.source not in _SOURCES:
            raise ConfigError(f"--scale {self.source}: unknown; give {USAGE}")
        if self.source in ("height", "marker") and self.metres is None:
            raise ConfigError(f"--scale {self.source}: needs METRES; give {USAGE}")
        for name, sources in (("metres", ("height", "marker")), ("reference", ("truth",))):
            if getattr(self, name) is not None and self.source not in sources:
                raise ConfigError(
                    f"scale.{name}: belongs to {' and '.join(sources)}, and --scale is {self.source}; give {USAGE}"
                )
        if self.marker_dictionary != "auto" and self.source != "marker":
            raise ConfigError(f"scale.marker_dictionary: belongs to marker, and --scale is {self.source}")
        for metres in [*([self.metres] if self.metres is not None else []), *(each[2] for each in self.distances)]:
            if not 0 < metres < 1e6:
                raise ConfigError(f"--scale {self.source}: {metres:g} m is no length; give a positive number of metres")
        if (self.source == "distance") != bool(self.distances):
            raise ConfigError(f"--scale {self.source}: two frames belong to `distance` alone; give {USAGE}")
        for first, last, _ in self.distances:
            if min(first, last) < 0 or first == last:
                raise ConfigError(f"--scale distance: frames {first} and {last} are no two places")
        if self.began is not None and self.reference is None:
            raise ConfigError("scale.began: belongs to a file (--scale truth FILE BEGAN)")


def scale_settings(given: Sequence[Sequence[str]]) -> list[str]:
    """What is written after each `--scale`, as `name=value` settings.

    Raises:
        ConfigError: other words than a source and its numbers, or two sources.
    """
    counts = {"depth": (0,), "truth": (0, 1, 2), "distance": (3,), "height": (1,), "marker": (1,)}
    for source, *rest in given:
        if source not in counts or len(rest) not in counts[source]:
            raise ConfigError(f"--scale {' '.join([source, *rest])}: give {USAGE}")
    source, *rest = given[0]
    if len(given) > 1 and any(words[0] != "distance" for words in given):
        raise ConfigError("--scale: is given twice; only `distance` can be, for several known distances")
    found = [f"scale.source={source}"]
    if source == "truth":
        return found + [
            f"scale.{name}={yaml_line(word)}" for name, word in zip(("reference", "began"), rest, strict=False)
        ]
    try:
        if source == "distance":
            triples = [f"[{int(first)}, {int(last)}, {float(metres)!r}]" for _, first, last, metres in given]
            found.append(f"scale.distances=[{', '.join(triples)}]")
        elif rest:
            found.append(f"scale.metres={float(rest[0])!r}")
    except ValueError:
        raise ConfigError(f"--scale {' '.join(given[-1])}: not numbers; give {USAGE}") from None
    return found
