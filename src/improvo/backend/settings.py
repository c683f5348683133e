"""Settings of the objective and of the solver; importable without the compiled kernels."""

from __future__ import annotations

from dataclasses import dataclass

from improvo.errors import ConfigError


@dataclass(frozen=True)
class ObjectiveSettings:
    """Constants of the bundle adjustment objective (paper, "Depth Regularization", "Final Bundle Adjustment...").

    The paper gives no Huber width. One pixel is its own limit between a stable point and a doubtful one, about two
    standard deviations of good keypoints, and other widths were measured to make no difference (docs/backend.md).
    """

    huber_width: float = 1.0  # pixels; larger errors count linearly
    depth_min: float = 0.1  # map units; smaller depths are penalised
    depth_max: float = 5.0  # map units; larger depths are penalised
    depth_weight: float = 1.0  # factor of the depth regulariser d(Z), pixels squared per map unit squared; 0: off

    def __post_init__(self) -> None:
        if not self.huber_width > 0:
            raise ConfigError(f"huber_width={self.huber_width}: must be positive (large: no robust loss)")
        if not self.depth_min >= 0:
            raise ConfigError(f"depth_min={self.depth_min}: must not be negative")
        if not self.depth_min <= self.depth_max:
            raise ConfigError(f"depth_min={self.depth_min} is above depth_max={self.depth_max}: swap them")
        if not self.depth_weight >= 0:
            raise ConfigError(f"depth_weight={self.depth_weight}: must not be negative (0 turns the regulariser off)")


@dataclass(frozen=True)
class SolverSettings:
    """When Levenberg-Marquardt stops, and how it damps (the schedule of Nielsen 1999, as in Ceres)."""

    max_iterations: int = 100  # steps tried, accepted or not (paper, "VO Backend Implementation")
    relative_decrease: float = 1e-4  # stop when a step changes the cost by less than this share
    initial_damping: float = 1e-4  # share of the diagonal of the normal equations, before the first step
    min_damping: float = 1e-12  # keeps the system well defined with points seen once and with a free gauge
    max_damping: float = 1e12  # stop when no step this short lowers the cost
    min_diagonal: float = 1e-6  # smaller diagonal entries count as this in the damping
    min_gain: float = 1e-3  # accept a step that gives at least this share of the predicted decrease

    def __post_init__(self) -> None:
        if self.max_iterations < 0:
            raise ConfigError(f"max_iterations={self.max_iterations}: must not be negative")
        if not 0 < self.min_damping <= self.initial_damping <= self.max_damping:
            raise ConfigError("damping: needs 0 < min_damping <= initial_damping <= max_damping")
        if not self.min_diagonal > 0:
            raise ConfigError(f"min_diagonal={self.min_diagonal}: must be positive")
        for name in ("relative_decrease", "min_gain"):
            if not 0 <= getattr(self, name) < 1:
                raise ConfigError(f"{name}={getattr(self, name)}: is a share, at least 0 and under 1")
