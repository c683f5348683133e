"""SuperPoint's two stages: the detector on drawn shapes, then detector and descriptor on pairs of views."""

from __future__ import annotations

import torch
from torch import Tensor

from improvo.frontend.superpoint import SuperPoint
from improvo.training.augmentation.views import cell_centres
from improvo.training.settings import DetectorLossSettings, HomographiesSettings
from improvo.training.stages.base import DescriptorStage, Stage
from improvo.training.stages.losses import detector_loss


class MagicPointStage(Stage):
    """`improvo train shapes`: encoder and detector head ("MagicPoint", SuperPoint section 4).

    The descriptor head stays as it is.
    """

    network: SuperPoint

    def __init__(self, network: SuperPoint, settings: DetectorLossSettings | None = None) -> None:
        super().__init__()
        self.network = network
        self.settings = settings or DetectorLossSettings()
        network.descriptor.requires_grad_(False)

    def losses(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """See `Stage`; `batch` is that of `ShapeBatches`."""
        logits = self.network.detector(self.network.encode(batch["images"]))
        return {"loss": detector_loss(logits, batch["cells"], self.settings)}


class JointStage(DescriptorStage):
    """`improvo train homographies`: detector and descriptor on both views of a pair (SuperPoint, equations 1 to 6)."""

    def __init__(self, network: SuperPoint, settings: HomographiesSettings) -> None:
        super().__init__(network, settings.descriptor_loss, settings.masked_pixels)
        self.settings = settings
        self._cells = torch.from_numpy(cell_centres(settings.views.width, settings.views.height))

    def losses(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """See `Stage`; `batch` is that of `PairBatches`."""
        shared = self.network.encode(batch["images"])
        detector = detector_loss(self.network.detector(shared), batch["cells"], self.settings.detector)
        descriptor = self.descriptor_loss(self.network.descriptor(shared), batch, cells=self._cells)
        return {
            "loss": detector + self.settings.descriptor_weight * descriptor,
            "detector": detector,
            "descriptor": descriptor,
            "scale": self.log_scale.exp(),
        }
