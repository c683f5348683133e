"""Settings of the self-improvement loop; importable without torch."""

from __future__ import annotations

from dataclasses import dataclass, field

from improvo.errors import ConfigError
from improvo.evaluation.settings import SurvivalSettings
from improvo.frontend.settings import FrontendSettings
from improvo.odometry.run_settings import RunSettings
from improvo.odometry.settings import OdometrySettings
from improvo.sequences.base import SequenceSettings
from improvo.stability.settings import LabelSettings
from improvo.training.settings import OdometryTrainingSettings, OptimiserSettings

DEFAULT_START = "superpoint"


@dataclass(frozen=True)
class SplitSettings:
    """What training never sees, so that the rounds can be validated on it."""

    share: float = 0.2  # of the sequences, at least one; of a single sequence, its last part

    def __post_init__(self) -> None:
        if not 0 < self.share < 1:
            raise ConfigError(f"split.share={self.share}: must be between 0 and 1")


@dataclass(frozen=True)
class ValidationSettings:
    """How the rounds are compared."""

    survival: SurvivalSettings = field(default_factory=SurvivalSettings)
    frames_lost: float = 0.01  # share of the frames tracked by the best frontend so far that a better one may lose
    calibration_images: int = 24  # training frames that activation ranges are measured on, for the int8 runtime


@dataclass(frozen=True)
class ImproveSettings:
    """Everything that `improvo improve` depends on."""

    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    frontend: FrontendSettings = field(default_factory=lambda: FrontendSettings(name=DEFAULT_START))  # at the start
    odometry: OdometrySettings = field(default_factory=OdometrySettings)
    labels: LabelSettings = field(default_factory=LabelSettings)
    split: SplitSettings = field(default_factory=SplitSettings)
    training: OdometryTrainingSettings = field(
        default_factory=lambda: OdometryTrainingSettings(
            optimiser=OptimiserSettings(steps=1000, decay_steps=350, learning_rate=5e-4)
        )
    )
    validation: ValidationSettings = field(default_factory=ValidationSettings)

    def run_settings(self, sequence: SequenceSettings, frontend: FrontendSettings) -> RunSettings:
        """The odometry's settings for some frames and a frontend."""
        return RunSettings(sequence, frontend, self.odometry, self.labels)
