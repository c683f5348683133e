"""All settings of `improvo run` and of `improvo label`, and what the paper fixes of them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TypeVar, overload

from improvo.frontend.settings import FrontendSettings
from improvo.odometry.settings import PAPER, OdometrySettings
from improvo.sequences.base import SequenceSettings
from improvo.stability.settings import LabelQualitySettings, LabelSettings


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


# The paper's rule on the raw tracks, with the Huber loss of its objective and without the quality gate.
PAPER_LABELS = LabelSettings(
    min_observations=10,
    stable_mean_error=1.0,
    unstable_max_error=5.0,
    loss="huber",
    loss_width=PAPER.paper_objective.huber_width,
    quality=LabelQualitySettings(enabled=False),
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
