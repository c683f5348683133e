"""The settings of `improvo export features`; importable without anything heavy."""

from __future__ import annotations

from dataclasses import dataclass, field

from improvo.config import check_seed
from improvo.errors import ConfigError
from improvo.frontend.settings import FrontendSettings
from improvo.sequences.base import SequenceSettings


@dataclass(frozen=True)
class FeatureExportSettings:
    """Which features, and which pairs of frames are matched."""

    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    frontend: FrontendSettings = field(default_factory=FrontendSettings)
    window: int = 10  # each frame is matched with so many before it
    loop_every: int = 0  # every so-manyth frame is also matched with all such frames before it; 0: none
    max_distance: float = 0.7  # of mutual nearest neighbours, tau on unit descriptors
    min_matches: int = 15  # pairs with fewer are left out
    descriptors: str = "float16"  # float16 or float32, in the layout hloc
    seed: int = 0  # of COLMAP's verification

    def __post_init__(self) -> None:
        if self.window < 1 or self.loop_every < 0 or self.min_matches < 1:
            raise ConfigError("window and min_matches must be at least 1, loop_every at least 0")
        if self.descriptors not in ("float16", "float32"):
            raise ConfigError(f"descriptors `{self.descriptors}`: is float16 or float32")
        if not self.max_distance > 0:
            raise ConfigError(f"max_distance={self.max_distance}: must be positive; 0.7 is the paper's")
        check_seed(self.seed)
