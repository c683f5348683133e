"""`improvo train odometry`: VO adaptation of detector, descriptor and stability head (paper, "Training Details")."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from improvo.errors import ConfigError
from improvo.frontend.superpoint import SuperPoint, sample_descriptors, sample_stability
from improvo.training.losses import detector_loss, info_nce_loss, stability_loss
from improvo.training.settings import OdometryTrainingSettings
from improvo.training.trainer import Stage


class VOAdaptationStage(Stage):
    """All three heads on both views of a pair; what the odometry does not know counts for nothing.

    Args:
        stable_per_unstable: see `stability_loss`.
    """

    def __init__(self, network: SuperPoint, settings: OdometryTrainingSettings, stable_per_unstable: float) -> None:
        super().__init__()
        self.network = network
        self.settings = settings
        self.stable_per_unstable = stable_per_unstable
        self.log_scale = nn.Parameter(torch.tensor(math.log(20.0)))  # inverse temperature of the InfoNCE loss
        if settings.stability_alone:
            self.requires_grad_(False)
            self._head.requires_grad_(True)

    def train(self, mode: bool = True) -> VOAdaptationStage:
        """As in torch; what is not trained keeps its batch norm's statistics too."""
        super().train(mode)
        if self.settings.stability_alone:
            self.network.eval()
            self._head.train(mode)
        return self

    def losses(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """See `Stage`; `batch` is that of `TrackedPairs`."""
        settings = self.settings
        if settings.stability_alone:
            loss = self._stability(self._head(self.network.encode(batch["images"])), batch)
            return {"loss": loss, "stability": loss}
        output = self.network(batch["images"])
        detector = detector_loss(output.detector_logits, batch["cells"], settings.detector)
        with torch.autocast(output.descriptors.device.type, enabled=False):
            first, second = output.descriptors.float().chunk(2)
            points_a, points_b = batch["points_a"], batch["points_b"]
            a, b = sample_descriptors(first, points_a), sample_descriptors(second, points_b)
            descriptor = info_nce_loss(
                a, b, points_a, points_b, batch["valid"], self.log_scale.exp().clamp(max=100), settings.masked_pixels,
                negative=batch["negative"], group=len(a) if settings.negatives_across else 1,
            )  # fmt: skip
        stability = self._stability(output.stability_logits, batch)
        total = settings.detector_weight * detector + settings.descriptor_weight * descriptor
        return {
            "loss": total + settings.stability_weight * stability,
            "detector": detector,
            "descriptor": descriptor,
            "stability": stability,
            "correspondences": batch["valid"].sum(dim=1).float().mean(),
        }

    def _stability(self, logits: Tensor, batch: dict[str, Tensor]) -> Tensor:
        with torch.autocast(logits.device.type, enabled=False):
            sampled = sample_stability(logits.float(), batch["stability_points"])
            return stability_loss(sampled, batch["stability"], self.stable_per_unstable)

    @property
    def _head(self) -> nn.Sequential:
        if self.network.stability is None:
            raise ConfigError("VO adaptation needs a network with a stability head")
        return self.network.stability
