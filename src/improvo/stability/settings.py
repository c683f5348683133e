"""Settings of the stability labels; importable without the compiled kernels."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from improvo.errors import ConfigError


@dataclass(frozen=True)
class LabelQualitySettings:
    """The quality gate: where the odometry is not to be trusted, its labels are withheld (docs/labels.md)."""

    enabled: bool = True
    max_median_error: float = 2.0  # pixels; a frame whose long tracks fit worse is not trusted
    min_median_parallax_deg: float = 0.3  # a frame whose long tracks have less says nothing on depth: pure rotation
    doubted_before_contradiction: int = 18  # frames; the odometry's own alarm looks back that far
    min_trusted_share: float = 0.5  # of a track's observations, for it to keep its label

    def __post_init__(self) -> None:
        if not self.max_median_error > 0:
            raise ConfigError(f"max_median_error={self.max_median_error}: must be positive")
        if not 0 <= self.min_median_parallax_deg <= 180:
            raise ConfigError(
                f"min_median_parallax_deg={self.min_median_parallax_deg}: is an angle of 0 to 180 degrees"
            )
        if self.doubted_before_contradiction < 0:
            raise ConfigError(
                f"doubted_before_contradiction={self.doubted_before_contradiction}: is frames, and not negative"
            )
        if not 0 <= self.min_trusted_share <= 1:
            raise ConfigError(f"min_trusted_share={self.min_trusted_share}: must be between 0 and 1")


@dataclass(frozen=True)
class LabelSettings:
    """The rule of the paper (eq. stability) and how a track's 3D point is found for it (docs/labels.md)."""

    min_observations: int = 10  # T_j; shorter tracks are ignored
    stable_mean_error: float = 1.0  # pixels; stable if the mean error is not above it
    unstable_max_error: float = 5.0  # pixels; else unstable if the largest error is not below it
    loss: Literal["geman_mcclure", "huber"] = "geman_mcclure"  # of the robust solve
    loss_width: float = 2.0  # pixels
    quality: LabelQualitySettings = field(default_factory=LabelQualitySettings)  # beyond the paper

    def __post_init__(self) -> None:
        if self.min_observations < 2:
            raise ConfigError(f"min_observations={self.min_observations}: a point needs at least 2")
        if not 0 < self.stable_mean_error <= self.unstable_max_error:
            raise ConfigError("labels: needs 0 < stable_mean_error <= unstable_max_error")
        if self.loss not in ("geman_mcclure", "huber"):
            raise ConfigError(f"labels loss={self.loss!r}: must be geman_mcclure or huber")
        if not self.loss_width > 0:
            raise ConfigError(f"labels loss_width={self.loss_width}: must be positive")
