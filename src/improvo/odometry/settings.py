"""All settings of the odometry."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from improvo.backend.settings import ObjectiveSettings, SolverSettings
from improvo.errors import ConfigError


@dataclass(frozen=True)
class MatchingSettings:
    """Matching of consecutive frames (paper, "Point Tracks")."""

    max_distance: float = 0.7  # tau on unit descriptors; binary ones use the equivalent share of bits
    # A link farther than this from the frame's median flow is dropped; a share of the image width. 0 keeps every
    # link, as the paper does.
    flow_outlier_limit: float = 0.0
    search_radius: float = 8.0  # pixels at a width of 640, between a map point's projection and its keypoint
    search_frames: int = 60  # search by projection is for the map points of this many last frames

    def __post_init__(self) -> None:
        if not self.flow_outlier_limit >= 0:
            raise ConfigError(
                f"flow_outlier_limit={self.flow_outlier_limit}: is a share of the image width, 0 for no limit"
            )


@dataclass(frozen=True)
class StartSettings:
    """When two views are good enough to start a map (mode `robust`)."""

    min_points: int = 30  # of a map, with parallax; as many tracks in common, and twice as many matches, are needed
    min_rotation_residual: float = 2.0  # pixels, median that the best pure rotation leaves of the matches
    max_buffered: int = 300  # frames in the initialisation buffer; the oldest leaves it without a pose
    epipolar_error: float = 1.0  # pixels, RANSAC threshold of the essential matrix and of the homography
    max_homography_ratio: float = 0.7  # homography inliers over essential inliers; more is too little parallax, unless
    # twice min_points of the essential inliers are no homography inliers, or
    plane_ratio: float = 0.8  # the ratio is at least this: then the scene is one plane, and its homography is used
    max_second_motion: float = 0.5  # spread over the picture of another motion, as a share of the first one's
    min_parallax_deg: float = 1.0  # of a point, for it to count
    min_inlier_share: float = 0.3  # essential inliers of the matches
    max_mean_error: float = 1.2  # pixels, after adjustment and pruning
    max_lost: int = 4  # buffered frames in a row, such as black ones, that may stay without a pose
    max_cooldown: int = 30  # frames between two tries; it begins with 3 and doubles with each costly failure


@dataclass(frozen=True)
class WindowSettings:
    """Which poses the window adjusts."""

    recent: int = 15  # last consecutive frames, free; one of them at least is a keyframe
    keyframes: int = 15  # older keyframes, free
    fixed: int = 30  # still older keyframes; their poses stay, their observations count
    keyframe_motion: float = 0.05  # median pixel motion since the last keyframe, as a share of the image width
    keyframe_shared: float = 0.6  # or: share of the last keyframe's map points still seen
    max_error: float = 3.0  # pixels; observations over it are dropped, and the window is solved again
    paper_poses: int = 30  # N_last, of the mode `paper`

    def __post_init__(self) -> None:
        if min(self.recent, self.keyframes, self.fixed) < 1:
            raise ConfigError("window: recent, keyframes and fixed must be at least 1")
        if self.paper_poses < 2:
            raise ConfigError(f"window.paper_poses={self.paper_poses}: must be at least 2")


@dataclass(frozen=True)
class TrackingLossSettings:
    """When a frame, and when a segment, counts as lost."""

    min_inliers: int = 12
    wrong_share: float = 0.1  # of wrong matches that agree with a wrong pose, where the scene repeats or is mirrored
    max_lost_frames: int = 10  # more frames than this without a pose end the segment


@dataclass(frozen=True)
class HealthSettings:
    """The independent check of the map against two views (see `improvo.odometry.alarms.health`)."""

    interval: int = 5  # frames between two checks
    gaps: tuple[int, ...] = (3, 6, 12)  # frames between the two views of a check
    epipolar_error: float = 1.5  # pixels
    min_inlier_share: float = 0.4  # of the two views' own essential matrix; fewer may agree by repeated texture
    max_turn_deg: float = 5.0  # between both rotations; one farther off is of a mover or of repeated texture
    rounds: int = 3  # consecutive checks that are evaluated together
    min_evidence: int = 100  # inliers in all of them; fewer decide nothing
    min_agreement: float = 0.85  # right maps stay over 0.90, wrong ones fall under 0.80
    provisional_frames: int = 60  # a map is provisional this long: contradicted, it starts anew over the same frames


@dataclass(frozen=True)
class VerdictSettings:
    """When a segment's path is believed (see `improvo.odometry.verdict`)."""

    window: int = 12  # keyframes that are adjusted together from each part of the evidence; half of them overlap
    # What a change of scale between two windows moves the path by: % of it for a change by the factor e. Calibrated on
    # simulated and real recordings with truth (docs/odometry.md).
    scale_share: float = 40.0
    usual_noise: float = 0.0016  # share of the picture's width; the estimate grows with noise that is larger
    max_error: float = 5.0  # % of the path; a larger estimated error makes a segment doubtful
    max_focal_change: float = 0.12  # of the logarithm of the focal length, within a window or from one to the next
    max_focal_error: float = 0.2  # of the logarithm of the focal length, from that of the camera as given
    max_scale_error: float = 0.1  # of the logarithm of the scale between two windows; more is an uncertain stretch

    def __post_init__(self) -> None:
        if self.window < 4:
            raise ConfigError(f"verdict.window={self.window}: must be at least 4 keyframes")
        if not (self.usual_noise > 0 and self.max_error > 0):
            raise ConfigError("verdict: usual_noise and max_error must be positive")


@dataclass(frozen=True)
class BridgingSettings:
    """When a new map is joined with that of a segment that ended before (see `improvo.odometry.mapping.bridging`)."""

    max_frames: int = 300  # since the former segment's last frame; 0 joins nothing
    max_scale_error: float = 0.05  # standard error of the scale between both, relative

    def __post_init__(self) -> None:
        if self.max_frames < 0:
            raise ConfigError(f"bridging.max_frames={self.max_frames}: must not be negative (0 joins nothing)")


@dataclass(frozen=True)
class AttachedSettings:
    """What moves with the camera, such as a logo, is kept out of the map (see `improvo.odometry.alarms.attached`)."""

    enabled: bool = True
    noise: float = 1.5  # pixels (of a width of 640, or less) that a keypoint of something attached may move
    min_flow: float = 4.0  # times the noise: median motion of what moves, before two views are compared
    min_moving_cells: float = 0.4  # share of the picture's cells that moves; less may be a person before a still camera

    def __post_init__(self) -> None:
        if not (self.noise > 0 and self.min_flow >= 3 and 0 < self.min_moving_cells < 1):
            raise ConfigError("attached: noise must be positive, min_flow at least 3, min_moving_cells within 0 and 1")


@dataclass(frozen=True)
class RansacGateSettings:
    """Which keypoints a RANSAC may sample, by their stability (docs/odometry.md, "Stability")."""

    least_stability: float = 0.5  # of a keypoint, and of both ends of a match; 0 lets all in
    enough: int = 50  # where fewer pass, all are used, since a doubtful pose is better than none

    def __post_init__(self) -> None:
        if not 0 <= self.least_stability <= 1:
            raise ConfigError(f"ransac_gate.least_stability={self.least_stability}: is a probability between 0 and 1")


@dataclass(frozen=True)
class RefinementSettings:
    """When a keypoint goes to where its map point's patch lies (see `improvo.odometry.refinement`)."""

    frontends: Literal["networks", "all", "none"] = "networks"  # SIFT gains on one recording and loses on another
    max_start: float = 3.0  # pixels between keypoint and projection; a search begins at the projection only within
    max_move: float = 2.0  # pixels from the detected keypoint; one that would go farther stays
    min_correlation: float = 0.8  # of the grey values of both patches
    max_deviation: float = 0.3  # pixels, expected error of the new place
    max_area_ratio: float = 2.5  # between two pictures; beyond it the patch is taken anew from the newer one

    def __post_init__(self) -> None:
        if self.frontends not in ("networks", "all", "none"):
            raise ConfigError(f"refinement.frontends={self.frontends!r}: choose `networks`, `all` or `none`")
        if min(self.max_start, self.max_move, self.max_deviation) <= 0:
            raise ConfigError("refinement: max_start, max_move and max_deviation are pixels and must be positive")
        if not self.max_area_ratio > 1:
            raise ConfigError(f"refinement.max_area_ratio={self.max_area_ratio}: must be over 1")


@dataclass(frozen=True)
class OdometrySettings:
    """Settings of `VisualOdometry`."""

    mode: str = "robust"  # `robust`, or `paper`: previous pose, unit depth, nothing else
    seed: int = 0  # of every RANSAC
    matching: MatchingSettings = field(default_factory=MatchingSettings)
    start: StartSettings = field(default_factory=StartSettings)
    ransac_gate: RansacGateSettings = field(default_factory=RansacGateSettings)
    window: WindowSettings = field(default_factory=WindowSettings)
    loss: TrackingLossSettings = field(default_factory=TrackingLossSettings)
    health: HealthSettings = field(default_factory=HealthSettings)
    refinement: RefinementSettings = field(default_factory=RefinementSettings)
    verdict: VerdictSettings = field(default_factory=VerdictSettings)
    bridging: BridgingSettings = field(default_factory=BridgingSettings)
    attached: AttachedSettings = field(default_factory=AttachedSettings)
    objective: ObjectiveSettings = field(default_factory=lambda: ObjectiveSettings(depth_weight=0.0))
    solver: SolverSettings = field(default_factory=lambda: SolverSettings(max_iterations=8, relative_decrease=1e-3))
    paper_objective: ObjectiveSettings = field(default_factory=ObjectiveSettings)  # of the mode `paper`
    paper_solver: SolverSettings = field(default_factory=lambda: SolverSettings(100, relative_decrease=1e-6))

    def __post_init__(self) -> None:
        if self.mode not in ("robust", "paper"):
            raise ConfigError(f"mode {self.mode!r}: choose `robust` or `paper`")


# What the paper fixes ("Point Tracks", "Depth Regularization", "Final Bundle Adjustment Objective", "VO Backend
# Implementation"), said in full so that no default can change it. It gives no Huber width and no tolerance.
PAPER = OdometrySettings(
    mode="paper",
    matching=MatchingSettings(max_distance=0.7, flow_outlier_limit=0.0),
    window=WindowSettings(paper_poses=30),
    paper_objective=ObjectiveSettings(depth_min=0.1, depth_max=5.0, depth_weight=1.0),
    paper_solver=SolverSettings(max_iterations=100, relative_decrease=1e-6),
)
