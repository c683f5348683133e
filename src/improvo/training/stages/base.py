"""What a training stage is: a network and its losses on a batch."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from improvo.frontend.superpoint import SuperPoint, sample_descriptors
from improvo.training.settings import HINGE
from improvo.training.stages.losses import hinge_loss, info_nce_loss


class Stage(nn.Module):
    """A network and its losses. The subclasses are the stages."""

    network: nn.Module

    def losses(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Named scalars of one batch; `loss` is the one that is minimised."""
        raise NotImplementedError


class DescriptorStage(Stage):
    """A stage that teaches descriptors on pairs of views.

    Args:
        network: to train.
        loss: `info_nce` or `hinge`.
        masked_pixels: points nearer than this are not each other's negatives (InfoNCE).
    """

    network: SuperPoint

    def __init__(self, network: SuperPoint, loss: str, masked_pixels: float) -> None:
        super().__init__()
        self.network = network
        self.loss, self.masked_pixels = loss, masked_pixels
        self.log_scale = nn.Parameter(torch.tensor(math.log(20.0)))  # inverse temperature of the InfoNCE loss

    def descriptor_loss(
        self, descriptors: Tensor, batch: dict[str, Tensor], group: int = 1, cells: Tensor | None = None
    ) -> Tensor:
        """The loss of the descriptors of both views.

        Args:
            descriptors: (2B, D, Hc, Wc) as the network gives them, first the a views, then the b views.
            batch: `points_a`, `points_b` (B, N, 2) pixels, `valid` (B, N) bool, and where given `negative` (B, N) bool:
                rows that may be wrong partners of others. Without it these are the valid ones.
            group: so many consecutive pairs are each other's negatives (InfoNCE).
            cells: (M, 2) pixels of view b whose descriptors the hinge loss compares with; `points_b` without it.
        """
        first, second = descriptors.float().chunk(2)
        points_a, points_b, valid = batch["points_a"], batch["points_b"], batch["valid"]
        negative = batch.get("negative", valid)
        with torch.autocast(first.device.type, enabled=False):
            a = sample_descriptors(first, points_a)
            if self.loss == HINGE and cells is not None:
                places = cells.to(a).expand(len(a), -1, -1)
                return hinge_loss(a, sample_descriptors(second, places), points_b, places, valid)
            b = sample_descriptors(second, points_b)
            if self.loss == HINGE:
                return hinge_loss(a, b, points_b, points_b, valid, negative)
            scale = self.log_scale.exp().clamp(max=100)
            return info_nce_loss(
                a, b, points_a, points_b, valid, scale, self.masked_pixels, negative=negative, group=group
            )
