"""All settings of `improvo run` and of `improvo label`, and what the paper fixes of them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TypeVar, overload

from improvo.errors import ConfigError
from improvo.odometry.settings import PAPER, OdometrySettings
from improvo.sequences.base import SequenceSettings
from improvo.stability.settings import LabelSettings, TrustSettings

DEFAULT_FRONTEND = "superpoint-vo"


@dataclass(frozen=True)
class FrontendSettings:
    """Which frontend, and how many of its keypoints."""

    name: str = DEFAULT_FRONTEND  # sift, orb, akaze, surf, a bundled network, or a .safetensors file
    max_keypoints: int = 1000
    use_stability: bool = True  # weigh observations with the frontend's stability, where it has one
    least_stability: float = 0.0  # drop keypoints that the frontend's stability head gives less; 0 keeps all

    def __post_init__(self) -> None:
        if not 0 <= self.least_stability <= 1:
            raise ConfigError(f"least_stability={self.least_stability}: is a probability between 0 and 1")
        if self.max_keypoints < 50:
            raise ConfigError(f"max_keypoints={self.max_keypoints}: odometry needs at least 50; 1000 is a good start")


@dataclass(frozen=True)
class RunSettings:
    """Everything that a run depends on; `run.json` records it."""

    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    frontend: FrontendSettings = field(default_factory=FrontendSettings)
    odometry: OdometrySettings = field(default_factory=OdometrySettings)
    labels: LabelSettings = field(default_factory=LabelSettings)


@dataclass(frozen=True)
class LabelRunSettings(RunSettings):
    """All settings of `improvo label`: those of a run, with a frontend that has no opinion of its own on stability."""

    frontend: FrontendSettings = field(default_factory=lambda: FrontendSettings(name="sift"))


# The paper's rule on the raw tracks, with the Huber loss of its objective and without the second opinion.
PAPER_LABELS = LabelSettings(
    min_observations=10,
    stable_mean_error=1.0,
    unstable_max_error=5.0,
    loss="huber",
    loss_width=PAPER.paper_objective.huber_width,
    second_opinion=TrustSettings(enabled=False),
)

Settings = TypeVar("Settings", bound=RunSettings)


@overload
def paper_run_settings() -> RunSettings: ...


@overload
def paper_run_settings(base: Settings) -> Settings: ...


def paper_run_settings(base: RunSettings | None = None) -> RunSettings:
    """What the paper fixes of a run, and nothing else: the preset `paper`.

    Args:
        base: settings of everything that the paper leaves open, such as the frontend; the defaults of a run if None.
    """
    return replace(base or RunSettings(), odometry=PAPER, labels=PAPER_LABELS)
