"""All settings of `improvo run`, dense depth included."""

from __future__ import annotations

from dataclasses import dataclass, field

from improvo.depth.settings import DepthSettings
from improvo.odometry.run_settings import RunSettings
from improvo.odometry.scale.settings import ScaleSettings


@dataclass(frozen=True)
class DenseRunSettings(RunSettings):
    """What a run with dense depth depends on; `run.json` records it."""

    dense: bool = False  # leave depth.zip and dense.ply as well
    depth: DepthSettings = field(default_factory=DepthSettings)
    scale: ScaleSettings = field(default_factory=ScaleSettings)
