"""`improvo train odometry`: VO adaptation of detector, descriptor and stability head (paper, "Training Details")."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from improvo.errors import ConfigError
from improvo.frontend.superpoint import SuperPoint, sample_stability
from improvo.training.settings import OdometryTrainingSettings
from improvo.training.stages.base import DescriptorStage
from improvo.training.stages.losses import detector_loss, stability_loss


class VOAdaptationStage(DescriptorStage):
    """All three heads on both views of a pair. What the odometry does not know is ignored by every loss.

    Args:
        network: with a stability head.
        settings: weights of the losses.
        stable_per_unstable: see `stability_loss`; None does not balance the labels.
    """

    def __init__(
        self, network: SuperPoint, settings: OdometryTrainingSettings, stable_per_unstable: float | None
    ) -> None:
        super().__init__(network, settings.descriptor_loss, settings.masked_pixels)
        self.settings = settings
        self.stable_per_unstable = stable_per_unstable
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
        pairs = len(batch["valid"])
        descriptor = self.descriptor_loss(output.descriptors, batch, group=pairs if settings.negatives_across else 1)
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
