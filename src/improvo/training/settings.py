"""The settings of the training stages; importable without torch. Values that no stage knows are refused here."""

from __future__ import annotations

from dataclasses import dataclass, field

from improvo.frontend.architecture import ARCHITECTURES, CELL
from improvo.training.setting_checks import Checks

INFO_NCE, HINGE = "info_nce", "hinge"
DESCRIPTOR_LOSSES = (INFO_NCE, HINGE)
PRECISIONS = ("auto", "float32", "bfloat16")
DEVICES = ("auto", "cpu", "cuda", "cuda:1")
_DEVICE = r"cuda:\d+|mps"


@dataclass(frozen=True)
class OptimiserSettings:
    """How weights are updated; the same for every stage."""

    steps: int = 20000
    batch_size: int = 8  # images (shapes) or pairs of images (homographies) a step
    learning_rate: float = 1.5e-3
    weight_decay: float = 1e-4
    warmup_steps: int = 50  # linear from zero
    decay_steps: int = 4000  # the last steps, at most a third of all, over which the rate falls linearly to zero
    clip_norm: float = 5.0  # largest L2 norm of the gradient
    ema: float = 0.998  # decay of the moving average of the weights; the average is what is saved
    seed: int = 0
    device: str = "auto"  # auto takes CUDA where there is one
    # bfloat16 halves to thirds the time of a step where the processor has it (AVX-512 BF16, AMX, CUDA)
    precision: str = "auto"  # auto | float32 | bfloat16
    threads: int = 0  # of torch on the CPU; 0 leaves its default
    workers: int = 1  # processes that prepare batches; 0 prepares them in the training process
    checkpoint_minutes: float = 3.0
    log_every: int = 20  # steps between rows of metrics.jsonl

    def __post_init__(self) -> None:
        checks = Checks(self, "optimiser")
        checks.at_least(1, "steps", "batch_size", "log_every")
        checks.at_least(0, "weight_decay", "warmup_steps", "decay_steps", "seed", "threads", "workers")
        checks.at_least(0, "checkpoint_minutes")
        checks.positive("learning_rate", "clip_norm")
        checks.between(0, 1, "ema")
        checks.choice("device", DEVICES, _DEVICE)
        checks.choice("precision", PRECISIONS)


@dataclass(frozen=True)
class DetectorLossSettings:
    """What the detector head is taught beside SuperPoint's own loss."""

    position_weight: float = 1.0  # of the term that says where in its cell a keypoint is; 0 is SuperPoint's loss
    position_sigma: float = 0.7  # pixels; how sharply

    def __post_init__(self) -> None:
        checks = Checks(self, "detector")
        checks.at_least(0, "position_weight")
        checks.positive("position_sigma")


@dataclass(frozen=True)
class ViewSettings:
    """Random views of a picture, as a moving camera would see it."""

    height: int = 120
    width: int = 160
    smallest_zoom: float = 0.7  # pixels of the picture per pixel of the view, log-uniform
    largest_zoom: float = 2.0
    rotation_degrees: float = 45.0  # largest in-plane rotation between a view and the picture
    perspective: float = 0.2  # largest displacement of a corner, as a share of the view's side
    stretch: float = 0.35  # largest log-ratio of the scales along two perpendicular directions (foreshortening)
    shift: float = 0.3  # largest distance of the second view's centre from the first's, as a share of its side

    def __post_init__(self) -> None:
        checks = Checks(self, "views")
        for name in ("width", "height"):
            side = getattr(self, name)
            checks.that(
                name, side >= 2 * CELL and side % CELL == 0, f"must be a multiple of {CELL}, {2 * CELL} or more"
            )
        checks.positive("smallest_zoom", "largest_zoom")
        checks.that("largest_zoom", self.largest_zoom >= self.smallest_zoom, "must be no smaller than `smallest_zoom`")
        checks.between(0, 180, "rotation_degrees")
        checks.between(0, 1, "perspective", "shift")
        checks.at_least(0, "stretch")


@dataclass(frozen=True)
class PhotometricSettings:
    """Random changes of light and sensor. A share is the probability that a change is applied."""

    brightness: float = 40.0  # grey levels, largest
    contrast: tuple[float, float] = (0.5, 1.4)
    gamma: tuple[float, float] = (0.6, 1.7)
    shade_share: float = 0.4
    shade: float = 0.55  # largest darkening or brightening of a soft ellipse
    vignette_share: float = 0.2
    blur_share: float = 0.25
    blur_sigma: float = 1.2  # pixels, largest
    motion_share: float = 0.3
    motion_length: int = 5  # pixels, longest
    noise: float = 14.0  # grey levels, largest standard deviation
    speckle: float = 0.0015  # largest share of pixels that become black or white
    jpeg_share: float = 0.3
    jpeg_quality: tuple[int, int] = (40, 95)

    def __post_init__(self) -> None:
        checks = Checks(self, "photometric")
        checks.between(0, 1, "shade_share", "vignette_share", "blur_share", "motion_share", "jpeg_share")
        checks.between(0, 1, "shade", "speckle")
        checks.at_least(0, "brightness", "blur_sigma", "motion_length", "noise")
        checks.interval("contrast", above=0)
        checks.interval("gamma", above=0)
        checks.interval("jpeg_quality", above=0, most=100)
        low, high = self.jpeg_quality
        checks.that("jpeg_quality", low < high, "must be two numbers, the second larger than the first")


@dataclass(frozen=True)
class AdaptationSettings:
    """Homographic adaptation: what a detector finds again in many random views of a picture."""

    views: int = 30
    keypoints_per_view: int = 300
    border: int = 3  # pixels along the edge of a view that count for nothing
    suppression: int = 4  # pixels, radius of non-maximum suppression on the consensus
    accepted: float = 0.3  # a point that so large a share of the views finds again is a label
    undecided: float = 0.15  # from this share up to `accepted` it is neither label nor background

    def __post_init__(self) -> None:
        checks = Checks(self, "adaptation")
        checks.at_least(1, "views", "keypoints_per_view")
        checks.at_least(0, "border", "suppression")
        checks.between(0, 1, "accepted", "undecided")
        checks.that("undecided", self.undecided <= self.accepted, "must be no larger than `accepted`")


@dataclass(frozen=True)
class HomographiesSettings:
    """`improvo train homographies`: homographic adaptation, then detector and descriptor on pairs of views."""

    architecture: str = "superpoint"  # superpoint | superpoint-small
    # channels of the first four layers that are used, the others stay zero (`improvo.frontend.channel_pruning`); 0 for
    # as many as the weights use that are started from
    stem_channels: int = 0
    longer_side: int = 320  # pixels; larger pictures are reduced on loading
    shapes: int = 450  # drawn pictures with exact corners among the others; 0 leaves them out
    shapes_share: float = 0.12  # of the pairs
    descriptor_loss: str = "info_nce"  # info_nce | hinge (SuperPoint's own)
    descriptor_weight: float = 1.0
    points: int = 256  # correspondences a pair; half of them at labeled keypoints (info_nce; hinge takes all cells)
    masked_pixels: float = 8.0  # points nearer than this are not each other's negatives (info_nce)
    detector: DetectorLossSettings = field(default_factory=DetectorLossSettings)
    optimiser: OptimiserSettings = field(default_factory=OptimiserSettings)
    views: ViewSettings = field(default_factory=ViewSettings)
    photometric: PhotometricSettings = field(default_factory=PhotometricSettings)
    adaptation: AdaptationSettings = field(default_factory=AdaptationSettings)

    def __post_init__(self) -> None:
        checks = Checks(self)
        checks.choice("architecture", ARCHITECTURES)
        checks.choice("descriptor_loss", DESCRIPTOR_LOSSES)
        checks.at_least(0, "stem_channels", "shapes", "descriptor_weight", "masked_pixels")
        checks.at_least(2, "points")
        checks.at_least(2 * CELL, "longer_side")
        checks.that("shapes_share", 0 <= self.shapes_share < 1, "must be 0 or more and less than 1")


@dataclass(frozen=True)
class ShapesSettings:
    """`improvo train shapes`: a detector from drawn shapes alone ("MagicPoint")."""

    architecture: str = "superpoint"  # superpoint | superpoint-small
    detector: DetectorLossSettings = field(default_factory=DetectorLossSettings)
    optimiser: OptimiserSettings = field(default_factory=lambda: OptimiserSettings(batch_size=32))
    views: ViewSettings = field(default_factory=ViewSettings)
    photometric: PhotometricSettings = field(default_factory=PhotometricSettings)

    def __post_init__(self) -> None:
        Checks(self).choice("architecture", ARCHITECTURES)


@dataclass(frozen=True)
class LandmarkSettings:
    """What is known of a frame beyond the tracks that observe it; pixels are those of the training picture."""

    shared: bool = True  # the tracks of one map point are labeled together; False is the paper: each for itself
    unseen: bool = True  # stable points are also known where only their projection shows them; False is the paper
    reprojected: bool = True  # a stable point lies at its projection, not at the keypoint; False is the paper
    # pixels; an unstable track with a smaller median error has a wrong link or two. That says nothing about the place
    # it shows, so it is not taught as unstable; 0 is the paper
    unstable_median_error: float = 1.0
    # nor is an unstable track taught if one link makes more than this share of the way that its error goes
    # (`improvo.training.data.wrong_links`); 1 is the paper
    unstable_largest_step: float = 0.25
    largest_correction: float = 2.0  # pixels of the recording between the two; beyond it the keypoint holds
    largest_view_angle_degrees: float = 40.0  # from the mean direction in which an unseen point was seen
    largest_distance_ratio: float = 1.7  # to its mean distance, in either direction
    # within this radius of an unseen point, a nearer point of the frame hides it, and one must be seen at all
    occlusion_pixels: float = 14.0
    occlusion_depth: float = 0.15  # by how much nearer, as a share

    def __post_init__(self) -> None:
        checks = Checks(self, "landmarks")
        checks.at_least(0, "unstable_median_error", "largest_correction", "occlusion_pixels")
        checks.between(0, 1, "unstable_largest_step", "occlusion_depth")
        checks.between(0, 180, "largest_view_angle_degrees")
        checks.at_least(1, "largest_distance_ratio")


@dataclass(frozen=True)
class PairSettings:
    """Which two frames make a pair, and what is taught about them."""

    largest_gap: int = 60  # frames (paper, "Training Details")
    wide_baselines: float = 0.5  # a gap is drawn with a density that rises with this power of it; 0 (paper) is uniform
    same_frame_share: float = 0.3  # of the pairs show one frame twice, where every pixel's partner is known
    replay_share: float = 0.5  # of the pairs are homography pairs of other pictures, where such are given
    least_points: int = 16  # points that two frames must share, else nearer ones are taken; 0 (the paper) asks for none
    points: int = 256  # correspondences taught per pair
    stability_points: int = 200  # labeled points taught per view, at most; up to half of them unstable ones
    # a cell in which no keypoint was ever followed to a neighbouring frame has none (the dustbin); False ignores it
    untracked_is_background: bool = True
    # False: labeled frames teach descriptors and stability; the detector learns from replay alone
    teach_detector: bool = True

    def __post_init__(self) -> None:
        checks = Checks(self, "pairs")
        checks.at_least(1, "largest_gap")
        checks.at_least(0, "wide_baselines", "least_points")
        checks.between(0, 1, "same_frame_share", "replay_share")
        checks.at_least(2, "points", "stability_points")


@dataclass(frozen=True)
class OdometryTrainingSettings:
    """`improvo train odometry`: VO adaptation, from label stores (paper, "Training Details")."""

    longer_side: int = 320  # pixels; larger frames are reduced on loading
    memory_mib: int = 64  # of labelled sequences that are kept open, in each process that prepares batches
    detector_weight: float = 0.3
    descriptor_weight: float = 1.0
    stability_weight: float = 1.0
    descriptor_loss: str = "info_nce"  # info_nce | hinge (SuperPoint's own)
    stability_balanced: bool = True  # stable and unstable labels weigh the same in all; False is the paper
    negatives_across: bool = False  # a descriptor must also differ from those of the batch's other pairs (info_nce)
    stability_alone: bool = False  # train only that head: keypoints and descriptors stay as they are
    masked_pixels: float = 8.0  # points nearer than this are not each other's negatives (info_nce)
    detector: DetectorLossSettings = field(default_factory=DetectorLossSettings)
    pairs: PairSettings = field(default_factory=PairSettings)
    landmarks: LandmarkSettings = field(default_factory=LandmarkSettings)
    optimiser: OptimiserSettings = field(
        default_factory=lambda: OptimiserSettings(steps=2000, decay_steps=700, learning_rate=5e-4)
    )
    views: ViewSettings = field(default_factory=ViewSettings)
    photometric: PhotometricSettings = field(default_factory=PhotometricSettings)

    def __post_init__(self) -> None:
        checks = Checks(self)
        checks.choice("descriptor_loss", DESCRIPTOR_LOSSES)
        checks.at_least(0, "detector_weight", "descriptor_weight", "stability_weight", "masked_pixels")
        checks.at_least(1, "memory_mib")
        checks.at_least(2 * CELL, "longer_side")
        good = not self.negatives_across or self.descriptor_loss == INFO_NCE
        checks.that("negatives_across", good, f"needs `descriptor_loss={INFO_NCE}`")
