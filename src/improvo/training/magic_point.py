"""`improvo train shapes`: the detector alone, on drawn shapes ("MagicPoint", SuperPoint section 4)."""

from __future__ import annotations

from torch import Tensor

from improvo.frontend.superpoint import SuperPoint
from improvo.training.losses import detector_loss
from improvo.training.settings import DetectorLossSettings
from improvo.training.trainer import Stage


class MagicPointStage(Stage):
    """Encoder and detector head; the descriptor head stays as it is."""

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
