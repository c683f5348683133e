"""Settings of the triangulation; importable without the compiled kernels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from improvo.errors import ConfigError


@dataclass(frozen=True)
class TriangulationSettings:
    """How the points of tracks are found while the poses are held."""

    loss: Literal["huber", "geman_mcclure"] = "huber"  # the second lets go of what does not fit (docs/labels.md)
    loss_width: float = 1.0  # pixels
    max_iterations: int = 10  # of the refinement by re-weighted least squares
    min_parallax_deg: float = 1.0  # smallest angle between two of a point's rays for it to count as found

    def __post_init__(self) -> None:
        if self.loss not in ("huber", "geman_mcclure"):
            raise ConfigError(f"triangulation loss={self.loss!r}: must be huber or geman_mcclure")
        if not self.loss_width > 0:
            raise ConfigError(f"triangulation loss_width={self.loss_width}: must be positive")
        if self.max_iterations < 0:
            raise ConfigError(f"triangulation max_iterations={self.max_iterations}: must not be negative")
        if not 0 <= self.min_parallax_deg <= 180:
            raise ConfigError(
                f"triangulation min_parallax_deg={self.min_parallax_deg}: is an angle of 0 to 180 degrees"
            )
