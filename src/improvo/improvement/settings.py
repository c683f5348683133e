"""Settings of the self-improvement loop; importable without torch."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from improvo.depth.settings import DepthSettings
from improvo.errors import ConfigError
from improvo.evaluation.pose.self_truth import SelfTruthSettings
from improvo.frontend.settings import FrontendSettings
from improvo.odometry.run_settings import RunSettings
from improvo.odometry.settings import OdometrySettings
from improvo.sequences.base import SequenceSettings
from improvo.stability.settings import LabelSettings
from improvo.training.held_settings import DevicePairSettings, ElsewhereSettings, HeldSettings
from improvo.training.settings import OdometryTrainingSettings, OptimiserSettings
from improvo.training.stages.descriptor_metric import MetricSettings

DEFAULT_START = "superpoint-small"  # on a CPU a step takes a quarter of the time of one of `superpoint`
HELD, METRIC, TRACKS = "held", "metric", "tracks"
USUAL_SHARE = 0.2  # that is held back
RECIPES = (HELD, METRIC, TRACKS)


@dataclass(frozen=True)
class SplitSettings:
    """What training never sees, so that the rounds can be validated on it."""

    # of the sequences, at least one; of a single sequence, its last part. Without it a fifth, and of a single one no
    # fewer than `least_frames`, or a third where that is less
    share: float | None = None
    # wide gaps are 20 to 90 frames; with fewer held back they have no pair, or ten of the same second
    least_frames: int = 60

    def __post_init__(self) -> None:
        if self.share is not None and not 0 < self.share < 1:
            raise ConfigError(f"split.share={self.share}: must be between 0 and 1")
        if self.least_frames < 0:
            raise ConfigError(f"split.least_frames={self.least_frames}: must not be negative")

    @property
    def share_of_sequences(self) -> float:
        """The share of the frames, or sequences, where there are several sequences."""
        return USUAL_SHARE if self.share is None else self.share

    def frames_of_one(self, frames: int) -> int:
        """How many frames of a single sequence are held back; the rest must be enough to learn from."""
        if self.share is not None:
            return round(self.share * frames)
        return max(round(USUAL_SHARE * frames), min(self.least_frames, frames // 3))


@dataclass(frozen=True)
class ReferenceSettings:
    """The fixed run of the frontend at the start, whose poses and depth teach and judge."""

    frames_per_second: float = 10.0  # that get a depth map, at least, of a long recording
    dense_up_to: int = 300  # frames of a short one that get a depth map, more often than so
    most_training: int = 900  # frames with a depth map, of all recordings together
    most_held_back: int = 300
    stretch_seconds: float = 10.0  # where there are more, whole stretches of this length are left out
    least_known: float = 0.05  # share of the pixels; a map that knows less is not kept
    depth: DepthSettings = field(default_factory=DepthSettings)

    def __post_init__(self) -> None:
        if not (self.frames_per_second > 0 and self.stretch_seconds > 0):
            raise ConfigError("settings `reference.frames_per_second` and `reference.stretch_seconds`: must be above 0")
        if min(self.dense_up_to, self.most_training, self.most_held_back) < 2:
            raise ConfigError(
                "settings `reference.dense_up_to`, `most_training` and `most_held_back`: at least 2 frames each"
            )
        if not 0 <= self.least_known <= 1:
            raise ConfigError(f"reference.least_known={self.least_known}: is a share between 0 and 1")


@dataclass(frozen=True)
class ValidationSettings:
    """How the rounds are compared."""

    matches: SelfTruthSettings = field(default_factory=lambda: SelfTruthSettings(pairs=100))
    gaps: tuple[int, ...] = ()  # frames between the two images of a pair; by default as far as `overlaps` says
    # share of a frame that the other one still shows, one for each gap; held in the hand about 1, 2 and 3 seconds
    overlaps: tuple[float, ...] = (0.65, 0.5, 0.4)
    min_pairs: int = 10  # of a gap; what is held back is too short for wider ones
    frames_lost: float = 0.01  # share of the frames tracked by the best frontend so far that a better one may lose
    segments_more: int = 0  # than with the best frontend so far, by which the odometry of a better one may break
    calibration_images: int = 24  # training frames that activation ranges are measured on, for the int8 runtime

    def __post_init__(self) -> None:
        if any(gap < 1 for gap in self.gaps) or len(set(self.gaps)) < len(self.gaps):
            raise ConfigError(f"validation.gaps={list(self.gaps)}: give different numbers of frames, each 1 or more")
        if not self.overlaps or not all(0 < share < 1 for share in self.overlaps):
            raise ConfigError("validation.overlaps: give shares between 0 and 1")
        if sorted(self.overlaps, reverse=True) != list(self.overlaps):
            raise ConfigError("validation.overlaps: give the largest first")
        if self.min_pairs < 1:
            raise ConfigError(f"validation.min_pairs={self.min_pairs}: must be at least 1")
        if not 0 <= self.frames_lost <= 1:
            raise ConfigError(f"validation.frames_lost={self.frames_lost}: is a share between 0 and 1")
        if self.segments_more < 0:
            raise ConfigError(f"validation.segments_more={self.segments_more}: must not be negative")
        if self.calibration_images < 1:
            raise ConfigError(f"validation.calibration_images={self.calibration_images}: must be at least 1")


@dataclass(frozen=True)
class ImproveSettings:
    """Everything that `improvo improve` depends on."""

    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    frontend: FrontendSettings = field(default_factory=lambda: FrontendSettings(name=DEFAULT_START))  # at the start
    odometry: OdometrySettings = field(default_factory=OdometrySettings)
    labels: LabelSettings = field(default_factory=LabelSettings)
    split: SplitSettings = field(default_factory=SplitSettings)
    reference: ReferenceSettings = field(default_factory=ReferenceSettings)
    # held: descriptors from dense pairs of frames, the other heads held to the start's, then a linear map of the
    # descriptors from such pairs, in closed form. metric: that map alone. tracks: all heads from tracks
    recipe: str = HELD
    control: bool = False  # also train, from the same start, by homographies of the same frames alone, and show it
    minutes: float = 0.0  # that training may take in each round; 0: as many steps as the following say
    # for each frame of the training part, at least 300 in all and at most `held.optimiser.steps`; 0: exactly those
    steps_per_frame: float = 1.0
    held: HeldSettings = field(
        default_factory=lambda: HeldSettings(
            frozen_layers=4,  # whose features of a frame are remembered
            fixed_statistics=True,
            scale=28.0,
            pairs=DevicePairSettings(
                group=1, whole_frames=1, alone=250, keypoint_share=0.7, largest_gap=5.0, least_overlap=0.1
            ),
            elsewhere=ElsewhereSettings(weight=1.0),
            optimiser=OptimiserSettings(  # 1200 steps take 4 minutes on a core with bfloat16
                steps=1200, batch_size=2, learning_rate=1e-3, decay_steps=400, warmup_steps=50, workers=0
            ),
        )
    )
    then_metric: bool = True  # the recipe `held` ends with what `metric` does, on the descriptors that it has trained
    # share of the way from the weights that a round starts from to those that the recipe `held` has trained from them,
    # which is gone: with most of what was learned here goes less of what was known of other places
    way: float = 0.8
    # then, in all rounds but the first, of the way from the weights that the loop started from
    later_way: float = 0.9
    metric: MetricSettings = field(default_factory=MetricSettings)  # of the recipe `metric`, and of that
    training: OdometryTrainingSettings = field(  # of the recipe `tracks`
        default_factory=lambda: OdometryTrainingSettings(
            optimiser=OptimiserSettings(steps=1000, decay_steps=350, learning_rate=5e-4)
        )
    )
    validation: ValidationSettings = field(default_factory=ValidationSettings)

    def __post_init__(self) -> None:
        if self.recipe not in RECIPES:
            raise ConfigError(f"recipe `{self.recipe}`: unknown; choose among {', '.join(RECIPES)}")
        for name in ("minutes", "steps_per_frame"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ConfigError(f"{name}={getattr(self, name):g}: must be 0 or more")
        for name in ("way", "later_way"):
            if not 0 < getattr(self, name) <= 1:
                raise ConfigError(f"{name}={getattr(self, name):g}: must be above 0 and at most 1")
        if self.minutes and self.recipe != HELD:
            raise ConfigError("minutes: only the recipe `held` chooses its steps by time; give steps instead")

    @property
    def teaches_labels(self) -> bool:
        """Whether a round trains with the labels of the training part; the others teach depth and poses."""
        return self.recipe == TRACKS or (self.recipe == HELD and not self.held.pairs.whole_frames)

    def run_settings(self, sequence: SequenceSettings, frontend: FrontendSettings) -> RunSettings:
        """The odometry's settings for some frames and a frontend.

        Where no labels teach, none is withheld: a path of doubtful scale still relates frames that are seconds apart.
        """
        quality = replace(self.labels.quality, enabled=self.labels.quality.enabled and self.teaches_labels)
        return RunSettings(sequence, frontend, self.odometry, replace(self.labels, quality=quality))
