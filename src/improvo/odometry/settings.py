"""All settings of the odometry."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from improvo.backend.settings import ObjectiveSettings
from improvo.config import check_seed
from improvo.errors import ConfigError


@dataclass(frozen=True)
class MatchingSettings:
    """Matching of consecutive frames (paper, "Point Tracks")."""

    max_distance: float = 0.7  # tau on unit descriptors; binary ones use the equivalent share of bits
    # A link farther than this from the frame's median flow is dropped; a share of the image width. 0 keeps every
    # link, as the paper does.
    flow_outlier_limit: float = 0.0

    def __post_init__(self) -> None:
        if not self.max_distance > 0:
            raise ConfigError(f"matching.max_distance={self.max_distance}: must be positive; 0.7 is the paper's")
        if not 0 <= self.flow_outlier_limit <= 1:
            raise ConfigError(
                f"flow_outlier_limit={self.flow_outlier_limit}: is a share of the image width, 0 for no limit"
            )


@dataclass(frozen=True)
class StartSettings:
    """When two views are good enough to start a map."""

    min_points: int = 30  # of a map, with parallax; as many tracks in common, and twice as many matches, are needed

    def __post_init__(self) -> None:
        if self.min_points < 5:
            raise ConfigError(f"start.min_points={self.min_points}: must be at least 5, the points of a motion")


@dataclass(frozen=True)
class WindowSettings:
    """Which poses the window adjusts."""

    # Last consecutive frames, free, at least one of them a keyframe; as many older keyframes, free too; and twice as
    # many still older ones, whose poses stay while their observations count.
    recent: int = 15
    paper_poses: int = 30  # N_last, of the mode `paper`

    def __post_init__(self) -> None:
        if self.recent < 1:
            raise ConfigError(f"window.recent={self.recent}: must be at least 1")
        if self.paper_poses < 2:
            raise ConfigError(f"window.paper_poses={self.paper_poses}: must be at least 2")

    @property
    def keyframes(self) -> int:
        """Older keyframes, free."""
        return self.recent

    @property
    def fixed(self) -> int:
        """Still older keyframes; their poses stay, their observations count."""
        return 2 * self.recent


@dataclass(frozen=True)
class TrackingLossSettings:
    """When a segment counts as lost."""

    max_lost_frames: int = 10  # more frames than this without a pose end the segment

    def __post_init__(self) -> None:
        if self.max_lost_frames < 0:
            raise ConfigError(f"loss.max_lost_frames={self.max_lost_frames}: must not be negative (0: the first one)")


@dataclass(frozen=True)
class VerdictSettings:
    """When a segment's path is believed (see `improvo.odometry.verdict`)."""

    max_error: float = 5.0  # % of the path; a larger estimated error makes a segment doubtful
    # `improvo run` and `label` track a segment near that again, with keypoints of another kind, and compare the paths
    second_run: bool = True

    def __post_init__(self) -> None:
        if not self.max_error > 0:
            raise ConfigError(f"verdict.max_error={self.max_error}: is % of the path, and must be positive")


@dataclass(frozen=True)
class BridgingSettings:
    """When a new map is joined with that of a segment that ended before (see `improvo.odometry.mapping.bridging`)."""

    max_frames: int = 300  # since the former segment's last frame; 0 joins nothing

    def __post_init__(self) -> None:
        if self.max_frames < 0:
            raise ConfigError(f"bridging.max_frames={self.max_frames}: must not be negative (0 joins nothing)")


@dataclass(frozen=True)
class AttachedSettings:
    """What moves with the camera, such as a logo, is kept out of the map (see `improvo.odometry.alarms.attached`)."""

    enabled: bool = True


@dataclass(frozen=True)
class RansacGateSettings:
    """Which keypoints a RANSAC may sample, by their stability (docs/odometry.md, "Stability")."""

    least_stability: float = 0.5  # of a keypoint, and of both ends of a match; 0 lets all in

    def __post_init__(self) -> None:
        if not 0 <= self.least_stability <= 1:
            raise ConfigError(f"ransac_gate.least_stability={self.least_stability}: is a probability between 0 and 1")


@dataclass(frozen=True)
class RefinementSettings:
    """Whose keypoints go to where their map points' patches lie (see `improvo.odometry.refinement`)."""

    frontends: Literal["networks", "all", "none"] = "networks"  # SIFT gains on one recording and loses on another

    def __post_init__(self) -> None:
        if self.frontends not in ("networks", "all", "none"):
            raise ConfigError(f"refinement.frontends={self.frontends!r}: choose `networks`, `all` or `none`")


@dataclass(frozen=True)
class OdometrySettings:
    """Settings of `VisualOdometry`."""

    mode: str = "robust"  # `robust`, or `paper`: previous pose, unit depth, nothing else
    seed: int = 0  # of every RANSAC
    # Pixels that a right match may be off its epipolar line; all gates in pixels follow from it (`odometry/gates.py`).
    tolerance: float = 1.5
    matching: MatchingSettings = field(default_factory=MatchingSettings)
    start: StartSettings = field(default_factory=StartSettings)
    ransac_gate: RansacGateSettings = field(default_factory=RansacGateSettings)
    window: WindowSettings = field(default_factory=WindowSettings)
    loss: TrackingLossSettings = field(default_factory=TrackingLossSettings)
    refinement: RefinementSettings = field(default_factory=RefinementSettings)
    verdict: VerdictSettings = field(default_factory=VerdictSettings)
    bridging: BridgingSettings = field(default_factory=BridgingSettings)
    attached: AttachedSettings = field(default_factory=AttachedSettings)
    paper_objective: ObjectiveSettings = field(default_factory=ObjectiveSettings)  # of the mode `paper`

    def __post_init__(self) -> None:
        if self.mode not in ("robust", "paper"):
            raise ConfigError(f"mode {self.mode!r}: choose `robust` or `paper`")
        check_seed(self.seed)
        if not self.tolerance > 0:
            raise ConfigError(f"tolerance={self.tolerance}: is pixels, and must be positive")


# What the paper fixes ("Point Tracks", "Depth Regularization", "Final Bundle Adjustment Objective", "VO Backend
# Implementation"), said in full so that no default can change it. It gives no Huber width and no tolerance.
PAPER = OdometrySettings(
    mode="paper",
    matching=MatchingSettings(max_distance=0.7, flow_outlier_limit=0.0),
    window=WindowSettings(paper_poses=30),
    paper_objective=ObjectiveSettings(depth_min=0.1, depth_max=5.0, depth_weight=1.0),
)
