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
    min_score: float = 0.4  # mean ZNCC over the better half of the neighbours; the refinement asks for more
    min_texture: float = 1.0  # grey levels, standard deviation within the window
    max_second: float = 0.9  # (1 - best) / (1 - second): of the best score and of the best one at another depth

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
class RefineSettings:
    """Finer depths on slanted surfaces, after the sweep."""

    steps: int = 3  # 0 leaves the sweep's depths
    same_surface: float = 0.06  # relative difference of inverse depths within one surface
    max_step: float = 0.02  # of the inverse depth, relative
    min_score: float = 0.7  # mean ZNCC over the better half of the neighbours at the end

    def __post_init__(self) -> None:
        if not 0 <= self.steps <= 20:
            raise ConfigError(f"refine.steps={self.steps}: is 0 to 20")
        if not (0 < self.same_surface < 1 and 0 < self.max_step < 1):
            raise ConfigError(f"refine.same_surface={self.same_surface}, max_step={self.max_step}: are between 0 and 1")
        if not -1 <= self.min_score < 1:
            raise ConfigError(f"refine.min_score={self.min_score}: is a correlation, at least -1 and under 1")


@dataclass(frozen=True)
class AgreementSettings:
    """When several frames agree on a depth."""

    least: int = 2  # other frames that have the same depth
    tolerance: float = 0.05  # relative difference of two depths that agree
    max_contradicting: float = 0.5  # frames that see through the point, as a share of those that agree

    def __post_init__(self) -> None:
        if not 0 <= self.least <= 32:
            raise ConfigError(f"agreement.least={self.least}: is 0 to 32 frames")
        if not 0 < self.tolerance < 1:
            raise ConfigError(f"agreement.tolerance={self.tolerance}: is a relative difference between 0 and 1")
        if not self.max_contradicting >= 0:
            raise ConfigError(f"agreement.max_contradicting={self.max_contradicting}: is 0 or more")


@dataclass(frozen=True)
class CloudSettings:
    """The fused point cloud."""

    voxel: float = 0.006  # side of the cell that gets one point, as a share of the first median depth
    least: int = 2  # other frames that agree on a point
    least_points: int = 2  # pixels, of any frames, that fall into a cell before it gets its point

    def __post_init__(self) -> None:
        if not self.voxel > 0:
            raise ConfigError(f"cloud.voxel={self.voxel}: is over 0, and a share of the first median depth")
        if self.least < 0 or self.least_points < 1:
            raise ConfigError(
                f"cloud.least={self.least}, least_points={self.least_points}: at least 0 frames and 1 pixel"
            )


@dataclass(frozen=True)
class DepthSettings:
    """All settings of dense depth."""

    reach: int = 60  # frames before and after a frame that may be its neighbours
    neighbours: NeighbourSettings = field(default_factory=NeighbourSettings)
    sweep: SweepSettings = field(default_factory=SweepSettings)
    refine: RefineSettings = field(default_factory=RefineSettings)
    agreement: AgreementSettings = field(default_factory=AgreementSettings)
    cloud: CloudSettings = field(default_factory=CloudSettings)

    def __post_init__(self) -> None:
        if not 1 <= self.reach <= 1000:
            raise ConfigError(f"depth.reach={self.reach}: is 1 to 1000 frames")
