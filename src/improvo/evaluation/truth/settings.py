"""The settings of `improvo truth`; importable without anything heavy."""

from __future__ import annotations

from dataclasses import dataclass, field

from improvo.config import check_seed
from improvo.errors import ConfigError
from improvo.sequences.base import SequenceSettings

CALIBRATE = ("none", "focal", "full")


@dataclass(frozen=True)
class TruthSettings:
    """Structure from motion, the scale, and what a truth must fulfil to be written."""

    max_features: int = 3000  # SIFT features per image
    overlap: int = 8  # each image is matched with so many following ones,
    farthest: int = 128  # and with those 16, 32, 64, ... images later, up to this one
    calibrate: str = "full"  # none: the camera stays; focal: focal lengths and distortion; full: principal point too
    seed: int = 0
    min_depths: int = 20  # points with depth that an image must have to say something about the scale
    min_registered: float = 0.9  # share of the images; below it nothing is written
    max_reprojection_px: float = 1.5  # mean error of the points; above it nothing is written
    max_disagreement: float = 0.05  # of the scale's source, relative; above it nothing is written
    max_scale_spread: float = 0.05  # between images, relative; above it nothing is written
    max_aspect_change: float = 0.02  # of fy / fx against the given camera; above it nothing is written
    max_motion_error: float = 0.03  # relative length of motions against those by depth; above it nothing is written

    def __post_init__(self) -> None:
        if self.max_features < 100 or self.overlap < 1 or self.farthest < 1 or self.min_depths < 1:
            raise ConfigError("truth: max_features must be 100 or more, overlap, farthest and min_depths 1 or more")
        if self.calibrate not in CALIBRATE:
            raise ConfigError(f"truth: calibrate `{self.calibrate}` is unknown; choose one of {', '.join(CALIBRATE)}")
        relative = (self.max_disagreement, self.max_scale_spread, self.max_motion_error, self.max_aspect_change)
        limits = (self.max_reprojection_px, *relative)
        if not (0 < self.min_registered <= 1 and all(limit > 0 for limit in limits)):
            raise ConfigError("truth: min_registered must be above 0 and at most 1, the other limits positive")
        check_seed(self.seed)


@dataclass(frozen=True)
class TruthCommandSettings:
    """Settings of `improvo truth`."""

    sequence: SequenceSettings = field(default_factory=SequenceSettings)
    truth: TruthSettings = field(default_factory=TruthSettings)
