"""All settings of `improvo run`."""

from __future__ import annotations

from dataclasses import dataclass, field

from improvo.frontend.settings import FrontendSettings
from improvo.odometry.settings import OdometrySettings
from improvo.sequences.base import SequenceSettings
from improvo.stability.settings import LabelSettings


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
