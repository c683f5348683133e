"""`improvo train homographies`: keypoints by homographic adaptation, then detector and descriptor on pairs of views."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from improvo.frontend.superpoint import SuperPoint, sample_descriptors
from improvo.training.losses import detector_loss, hinge_loss, info_nce_loss
from improvo.training.settings import HomographiesSettings
from improvo.training.trainer import Stage
from improvo.training.views import cell_centres


class JointStage(Stage):
    """Detector and descriptor together on both views of a pair (SuperPoint, equations 1 to 6)."""

    def __init__(self, network: SuperPoint, settings: HomographiesSettings) -> None:
        super().__init__()
        self.network = network
        self.settings = settings
        self.log_scale = nn.Parameter(torch.tensor(math.log(20.0)))  # inverse temperature of the InfoNCE loss

    def losses(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """See `Stage`; `batch` is that of `PairBatches`."""
        settings = self.settings
        shared = self.network.encode(batch["images"])
        detector = detector_loss(self.network.detector(shared), batch["cells"], settings.detector)
        first, second = self.network.descriptor(shared).float().chunk(2)
        with torch.autocast(first.device.type, enabled=False):
            points_a, points_b, valid = batch["points_a"], batch["points_b"], batch["valid"]
            a = sample_descriptors(first, points_a)
            if settings.descriptor_loss == "hinge":
                b = functional.normalize(second, dim=1).flatten(2).transpose(1, 2)
                centres = torch.from_numpy(cell_centres(settings.views.width, settings.views.height)).to(a)
                descriptor = hinge_loss(a, b, points_b, centres, valid)
            else:
                b = sample_descriptors(second, points_b)
                scale = self.log_scale.exp().clamp(max=100)
                descriptor = info_nce_loss(a, b, points_a, points_b, valid, scale, settings.masked_pixels)
        return {
            "loss": detector + settings.descriptor_weight * descriptor,
            "detector": detector,
            "descriptor": descriptor,
            "scale": self.log_scale.exp(),
        }
