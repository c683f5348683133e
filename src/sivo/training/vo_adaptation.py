"""`sivo train odometry`: VO adaptation of detector, descriptor and stability head (paper, "Training Details")."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from sivo.frontend.superpoint import SuperPoint, sample_descriptors, sample_stability
from sivo.training.losses import detector_loss, info_nce_loss, stability_loss
from sivo.training.settings import OdometryTrainingSettings
from sivo.training.trainer import Stage


class VOAdaptationStage(Stage):
    """All three heads on both views of a pair; what the odometry does not know counts for nothing."""

    def __init__(self, network: SuperPoint, settings: OdometryTrainingSettings) -> None:
        super().__init__()
        self.network = network
        self.settings = settings
        self.log_scale = nn.Parameter(torch.tensor(math.log(20.0)))  # inverse temperature of the InfoNCE loss

    def losses(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """See `Stage`; `batch` is that of `TrackedPairs`."""
        settings = self.settings
        output = self.network(batch["images"])
        detector = detector_loss(output.detector_logits, batch["cells"], settings.detector)
        with torch.autocast(output.descriptors.device.type, enabled=False):
            first, second = output.descriptors.float().chunk(2)
            points_a, points_b = batch["points_a"], batch["points_b"]
            a, b = sample_descriptors(first, points_a), sample_descriptors(second, points_b)
            descriptor = info_nce_loss(
                a, b, points_a, points_b, batch["valid"], self.log_scale.exp().clamp(max=100), settings.masked_pixels,
                negative=batch["negative"],
            )  # fmt: skip
            logits = sample_stability(output.stability_logits.float(), batch["stability_points"])
            stability = stability_loss(logits, batch["stability"])
        total = settings.detector_weight * detector + settings.descriptor_weight * descriptor
        return {
            "loss": total + settings.stability_weight * stability,
            "detector": detector,
            "descriptor": descriptor,
            "stability": stability,
            "correspondences": batch["valid"].sum(dim=1).float().mean(),
        }
