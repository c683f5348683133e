"""The settings of training with the detector held; importable without torch."""

from __future__ import annotations

from dataclasses import dataclass, field

from improvo.errors import ConfigError
from improvo.frontend.architecture import CELL
from improvo.training.setting_checks import Checks
from improvo.training.settings import OptimiserSettings, PhotometricSettings, ViewSettings

_ENCODER_LAYERS = 8


@dataclass(frozen=True)
class AlignmentSettings:
    """How the correspondences of two frames by depth are moved to where the pictures agree."""

    radius: int = 6  # pixels of a patch about its middle, in the halved and then in the full picture
    steps: int = 5  # of Gauss-Newton in either
    least_score: float = 0.75  # correlation (ZNCC) of two patches that agree
    least_texture: float = 4.0  # grey levels, the weaker of a patch's gradients, root mean square
    most_moved: float = 12.0  # pixels; what moves farther has gone to something else
    # pixels; places that agree follow one motion of the camera, which is estimated anew, to so much
    same_motion: float = 2.0
    least_together: int = 24  # places of a pair that agree; with fewer it stays as it is

    def __post_init__(self) -> None:
        checks = Checks(self, "pairs.align")
        checks.at_least(1, "radius", "steps")
        checks.at_least(8, "least_together")
        checks.between(0, 1, "least_score")
        checks.at_least(0, "least_texture")
        checks.positive("most_moved", "same_motion")


@dataclass(frozen=True)
class DevicePairSettings:
    """Which pairs are made on the device, and what is taught about them."""

    posed_share: float = 0.5  # of the pairs are of frames of posed sequences, where such are given
    two_frames: bool = True  # those show two frames, related by depth and poses; False: one frame twice, the control
    largest_gap: float = 3.0  # seconds between two frames
    least_overlap: float = 0.2  # share of either frame that the other shows
    depth_tolerance: float = 0.03  # of two frames' depths of a point, relative; beyond it something hides the point
    points: int = 384  # correspondences taught per pair, at most
    keypoint_share: float = 0.5  # of them are keypoints of the detector that is held, the rest lie anywhere
    group: int = 4  # so many pairs are each other's wrong partners
    alone: int = 0  # keypoints of either view that the other one does not show, at most, which are wrong partners
    # where above 0, two frames are shown as they are, so many pairs of one recording a step, and not through views
    whole_frames: int = 0
    whole_points: int = 500  # correspondences taught per pair of whole frames, at most
    frames_remembered: int = 256  # whole frames, at most, of which what is held to is looked up and not said again
    aligned: bool = False  # move correspondences by depth to where the pictures agree, and drop those that do not
    align: AlignmentSettings = field(default_factory=AlignmentSettings)

    def __post_init__(self) -> None:
        checks = Checks(self, "pairs")
        checks.between(0, 1, "posed_share", "keypoint_share", "least_overlap")
        checks.at_least(2, "points", "whole_points")
        checks.at_least(0, "whole_frames", "alone", "frames_remembered")
        checks.at_least(1, "group")
        checks.positive("largest_gap", "depth_tolerance")


@dataclass(frozen=True)
class ElsewhereSettings:
    """How descriptors and detector are held to the start's on bundled pictures of other places."""

    # of the squared distance of descriptors at keypoints, and of the divergence from the detector; 0 shows none
    weight: float = 0.0
    pictures: int = 1  # a step
    points: int = 300  # keypoints of a picture, at most, whose descriptors are held

    def __post_init__(self) -> None:
        checks = Checks(self, "elsewhere")
        checks.at_least(0, "weight")
        checks.at_least(1, "pictures", "points")


@dataclass(frozen=True)
class HeldSettings:
    """Descriptors trained on, while detector and stability are held to what other weights say of the same views."""

    longer_side: int = 640  # pixels; larger pictures are reduced on loading
    descriptor_weight: float = 1.0
    detector_weight: float = 1.0  # of the divergence from the detector of the weights that it starts from
    stability_weight: float = 1.0  # of the divergence from the stability of the teacher, where one is given
    stability_every: int = 4  # the teacher looks at every so many views
    masked_pixels: float = 8.0  # points nearer than this are not each other's negatives
    # the first ones of the encoder's eight layers that stay as they are; with 8 the other heads stay too, and need not
    # be held
    frozen_layers: int = 0
    # batch norm by the statistics of the weights that it starts from, as in use, and not by those of a few views
    fixed_statistics: bool = False
    scale: float = 20.0  # inverse temperature of the descriptor loss at the start
    compile: bool = False  # let torch fuse the network's operations; needs a C compiler
    pairs: DevicePairSettings = field(default_factory=DevicePairSettings)
    elsewhere: ElsewhereSettings = field(default_factory=ElsewhereSettings)
    optimiser: OptimiserSettings = field(
        default_factory=lambda: OptimiserSettings(
            batch_size=64, learning_rate=1e-3, steps=4000, decay_steps=1300, warmup_steps=100, workers=0
        )
    )
    views: ViewSettings = field(
        default_factory=lambda: ViewSettings(height=240, width=320, smallest_zoom=0.6, rotation_degrees=30.0)
    )
    photometric: PhotometricSettings = field(default_factory=PhotometricSettings)

    @property
    def holds_by_itself(self) -> bool:
        """Whether detector and stability stay as they are because nothing that they read is trained."""
        return self.frozen_layers == _ENCODER_LAYERS

    def __post_init__(self) -> None:
        checks = Checks(self)
        checks.at_least(0, "descriptor_weight", "detector_weight", "stability_weight", "masked_pixels")
        checks.positive("scale")
        checks.at_least(2 * CELL, "longer_side")
        checks.at_least(1, "stability_every")
        checks.that("frozen_layers", 0 <= self.frozen_layers <= _ENCODER_LAYERS, f"must be 0 to {_ENCODER_LAYERS}")
        if self.optimiser.batch_size % self.pairs.group:
            raise ConfigError(
                f"setting `optimiser.batch_size`: {self.optimiser.batch_size} is no multiple of `pairs.group` "
                f"{self.pairs.group}"
            )
        if self.optimiser.workers:
            raise ConfigError("setting `optimiser.workers`: batches made on the device need 0")
