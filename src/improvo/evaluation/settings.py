"""The settings of the protocols; importable without anything heavy."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from improvo.config import check_seed
from improvo.errors import ConfigError
from improvo.geometry.depth_sampling import SAMPLINGS
from improvo.geometry.ransac import poselib_installed
from improvo.odometry.settings import OdometrySettings
from improvo.sequences.base import SequenceSettings

ESTIMATORS = ("opencv", "poselib", "usac")
DEFAULT_ESTIMATORS = ("opencv", "poselib" if poselib_installed() else "usac")

# what frames of `redkitchen` (30 Hz) show of each other 30, 60 and 90 frames apart, in the median
USUAL_OVERLAPS = (0.8, 0.6, 0.45)

PEERS = ("xfeat", "aliked", "disk")  # other people's networks, see `improvo.evaluation.frontends.peers`

ALIGNMENTS = ("sim3", "se3", "none")


@dataclass(frozen=True)
class PoseSettings:
    """The pose protocol; the defaults are the paper's."""

    gaps: tuple[int, ...] = (30, 60, 90)  # frames between A and B, as delivered (after any stride)
    gap_seconds: tuple[float, ...] = ()  # in place of `gaps`: seconds between A and B
    overlaps: tuple[float, ...] = ()  # in place of `gaps`: shares of A that B shows too, the largest first
    pairs: int = 50  # random pairs per sequence and gap
    max_keypoints: int = 500
    estimators: tuple[str, ...] = DEFAULT_ESTIMATORS  # opencv is the paper's; poselib, usac (OpenCV's) are robust
    seed: int = 0  # of the pairs, the robust solver and the intervals
    max_rotation_deg: float = 5.0  # success is strictly below
    max_translation_m: float = 0.05  # success is strictly below
    max_error_px: float = 3.0  # a match is right, a keypoint repeated, strictly below this distance from the truth
    depth_sampling: str = "bilinear"  # bilinear or nearest
    depth_edge: float = 0.05  # relative depth difference between neighbouring pixels that makes a discontinuity
    curve_rotation_deg: float = 20.0  # accuracy curves, and the area under them, reach to here
    curve_translation_m: float = 0.5
    resamples: int = 1000  # of the bootstrap
    confidence: float = 0.95  # of the intervals
    shuffles: int = 1  # orders of a pair's matches that the solvers get; their mean is less noisy
    right_px: tuple[float, float] = (3.0, 8.0)  # shares of right matches are given strictly below these distances

    def __post_init__(self) -> None:
        if not self.gaps or min(self.gaps) < 1 or len(set(self.gaps)) < len(self.gaps):
            raise ConfigError(f"gaps {list(self.gaps)}: give different numbers of frames, each 1 or more")
        if self.gap_seconds and self.overlaps:
            raise ConfigError("gap_seconds and overlaps: give one of them")
        if not all(math.isfinite(each) and each > 0 for each in self.gap_seconds):
            raise ConfigError(f"gap_seconds {list(self.gap_seconds)}: must be positive")
        falling = list(self.overlaps) == sorted(set(self.overlaps), reverse=True)
        if not falling or not all(0 < each < 1 for each in self.overlaps):
            raise ConfigError(
                f"overlaps {list(self.overlaps)}: give shares below 1, the largest first, such as 0.8 0.6"
            )
        if min(self.pairs, self.resamples, self.shuffles) < 1 or self.max_keypoints < 4:
            raise ConfigError("pairs, resamples and shuffles must be at least 1, max_keypoints at least 4")
        unknown = set(self.estimators) - set(ESTIMATORS)
        if unknown or not self.estimators:
            raise ConfigError(f"estimators {list(self.estimators)}: choose among {', '.join(ESTIMATORS)}")
        if "poselib" in self.estimators and not poselib_installed():
            raise ConfigError("estimators: PoseLib is not installed here; choose usac, or pip install poselib")
        if self.depth_sampling not in SAMPLINGS:
            raise ConfigError(f"depth_sampling `{self.depth_sampling}` is unknown; choose among {', '.join(SAMPLINGS)}")
        limits = (self.max_rotation_deg, self.max_translation_m, self.max_error_px, self.depth_edge)
        curves = (self.curve_rotation_deg, self.curve_translation_m)
        if not (all(limit > 0 for limit in (*limits, *self.right_px, *curves)) and 0 < self.confidence < 1):
            raise ConfigError("thresholds must be positive, and confidence between 0 and 1")
        check_seed(self.seed)


@dataclass(frozen=True)
class TrajectorySettings:
    """How an estimated trajectory is held against the truth."""

    alignment: str = "sim3"  # sim3 (monocular), se3 (metric scale) or none (same world); each segment on its own
    max_time_difference: float = 0.02  # seconds between an estimated pose and the true one
    time_windows: tuple[float, ...] = (2.0, 5.0, 10.0)  # sub-trajectories in seconds, paper Table 2
    distance_windows: tuple[float, ...] = ()  # sub-trajectories in metres; KITTI: 100, 200, ... 800
    path_fractions: tuple[float, ...] = (0.1, 0.2, 0.3, 0.4, 0.5)  # sub-trajectories as a share of the true path
    window_tolerance: float = 0.2  # a sub-trajectory may be this share longer or shorter than asked for

    def __post_init__(self) -> None:
        if self.alignment not in ALIGNMENTS:
            raise ConfigError(f"alignment `{self.alignment}` is unknown; choose one of {', '.join(ALIGNMENTS)}")
        lengths = (*self.time_windows, *self.distance_windows, *self.path_fractions, self.window_tolerance)
        if not all(math.isfinite(length) and length > 0 for length in lengths):
            raise ConfigError("sub-trajectory lengths and window_tolerance must be positive numbers")
        for name, shares in (("path_fractions", self.path_fractions), ("window_tolerance", (self.window_tolerance,))):
            if not all(share <= 1 for share in shares):
                raise ConfigError(f"{name}: {max(shares):g} is no share, which is at most 1")
        if not self.max_time_difference >= 0:
            raise ConfigError("max_time_difference must be 0 or more seconds")


@dataclass(frozen=True)
class HomographySettings:
    """The homography protocol (DeTone et al. 2018, "SuperPoint", Sections 7.2 and 7.3)."""

    max_keypoints: int = 1000
    longest_side: int = 640  # pixels; larger images are made smaller, and their homographies with them
    max_error_px: float = 3.0  # a keypoint is repeated, a match is right, strictly below this distance
    corner_errors_px: tuple[float, ...] = (1.0, 3.0, 5.0)  # a homography is right strictly below this corner error
    ransac_px: float = 3.0  # inlier threshold of the homography's estimation
    views: int = 5  # random homographies per image, with --synthesize
    seed: int = 0
    resamples: int = 1000  # of the bootstrap
    confidence: float = 0.95

    def __post_init__(self) -> None:
        if self.max_keypoints < 4 or self.views < 1 or self.longest_side < 32 or self.resamples < 1:
            raise ConfigError("max_keypoints must be 4 or more, longest_side 32 or more, views and resamples 1 or more")
        limits = (*self.corner_errors_px, self.max_error_px, self.ransac_px)
        if not self.corner_errors_px or not all(limit > 0 for limit in limits):
            raise ConfigError("thresholds must be positive pixels")
        check_seed(self.seed)
        if not 0 < self.confidence < 1:
            raise ConfigError(f"confidence={self.confidence}: is a share between 0 and 1, such as 0.95")


@dataclass(frozen=True)
class PoseCommandSettings:
    """Settings of `improvo evaluate pose`."""

    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    pose: PoseSettings = field(default_factory=PoseSettings)


@dataclass(frozen=True)
class TrajectoryCommandSettings:
    """Settings of `improvo evaluate trajectory`."""

    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    trajectory: TrajectorySettings = field(default_factory=TrajectorySettings)


@dataclass(frozen=True)
class VoCommandSettings:
    """Settings of `improvo evaluate vo`: every 10th frame, as the paper makes it difficult."""

    sequence: SequenceSettings = field(default_factory=lambda: SequenceSettings(stride=10))
    max_keypoints: int = 1000
    odometry: OdometrySettings = field(default_factory=OdometrySettings)
    trajectory: TrajectorySettings = field(default_factory=TrajectorySettings)

    def __post_init__(self) -> None:
        if self.max_keypoints < 50:
            raise ConfigError(f"max_keypoints={self.max_keypoints}: odometry needs at least 50; 1000 is a good start")


@dataclass(frozen=True)
class HomographyCommandSettings:
    """Settings of `improvo evaluate homography`."""

    homography: HomographySettings = field(default_factory=HomographySettings)
