"""Settings of dense depth; importable without the compiled kernels."""

from __future__ import annotations

from dataclasses import dataclass, field

from improvo.errors import ConfigError


@dataclass(frozen=True)
class NeighbourSettings:
    """Which frames a frame is compared with."""

    least: int = 2  # fewer give no depth map
    most: int = 8  # half of them before the frame and half after it, where there are so many
    min_baseline: float = 0.03  # distance between the two cameras, as a share of the median depth
    max_baseline: float = 0.15
    max_turn_deg: float = 25.0
    min_overlap: float = 0.5  # share of the frame that the neighbour must show, at the median depth

    def __post_init__(self) -> None:
        if not 1 <= self.least <= self.most <= 32:
            raise ConfigError(f"neighbours.least={self.least}, most={self.most}: 1 to 32, and least no more than most")
        if not 0 < self.min_baseline < self.max_baseline:
            raise ConfigError(
                f"neighbours.min_baseline={self.min_baseline}, max_baseline={self.max_baseline}: "
                f"shares of the median depth, the second larger than the first"
            )
        if not 0 < self.max_turn_deg <= 90:
            raise ConfigError(f"neighbours.max_turn_deg={self.max_turn_deg}: is over 0 and at most 90 degrees")
        if not 0 <= self.min_overlap <= 1:
            raise ConfigError(f"neighbours.min_overlap={self.min_overlap}: is a share between 0 and 1")


@dataclass(frozen=True)
class SweepSettings:
    """The plane sweep of one frame."""

    planes: int = 80  # evenly spaced in inverse depth
    min_score: float = 0.6  # mean ZNCC over the better half of the neighbours
    min_texture: float = 2.0  # grey levels, standard deviation within the window
    max_second: float = 0.8  # (1 - best) / (1 - second): of the best score and of the best one at another depth

    def __post_init__(self) -> None:
        if not 8 <= self.planes <= 1000:
            raise ConfigError(f"sweep.planes={self.planes}: is 8 to 1000")
        if not -1 <= self.min_score < 1:
            raise ConfigError(f"sweep.min_score={self.min_score}: is a correlation, at least -1 and under 1")
        if not self.min_texture > 0:
            raise ConfigError(f"sweep.min_texture={self.min_texture}: is over 0 grey levels")
        if not 0 < self.max_second <= 1:
            raise ConfigError(f"sweep.max_second={self.max_second}: is over 0 and at most 1")


@dataclass(frozen=True)
class DepthSettings:
    """All settings of dense depth."""

    neighbours: NeighbourSettings = field(default_factory=NeighbourSettings)
    sweep: SweepSettings = field(default_factory=SweepSettings)
