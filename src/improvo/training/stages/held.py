"""Descriptors trained on while detector and stability are held to what they were: adaptation without unlearning."""

from __future__ import annotations

import math
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from improvo.frontend.superpoint import SuperPoint, sample_descriptors
from improvo.training.held_settings import HeldSettings
from improvo.training.stages.base import Stage
from improvo.training.stages.losses import held_loss, info_nce_loss


class HeldStage(Stage):
    """InfoNCE on the descriptors of both views of a pair; divergence from the teachers on the other heads."""

    def __init__(self, network: SuperPoint, settings: HeldSettings) -> None:
        super().__init__()
        self.network = network
        self.settings = settings
        for parameter in network.encoder[: settings.frozen_layers].parameters():
            parameter.requires_grad_(False)
        if settings.holds_by_itself:
            for head in (network.detector, network.stability):
                if head is not None:
                    head.requires_grad_(False)
        self.log_scale = nn.Parameter(torch.tensor(math.log(settings.scale)))  # inverse temperature of the InfoNCE loss
        self._compiled: Any = None

    def train(self, mode: bool = True) -> Self:
        """As in torch; batch norms keep their statistics where the settings say so."""
        super().train(mode)
        if self.settings.fixed_statistics:
            for part in self.modules():
                if isinstance(part, nn.BatchNorm2d):
                    part.eval()
        return self

    def losses(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """See `Stage`; `batch` is that of `DevicePairs`."""
        settings = self.settings
        if self._compiled is None:  # not before the average was copied from this
            self._compiled = torch.compile(self._heads) if settings.compile else self._heads
        seen = batch["stem"] if settings.frozen_layers else batch["images"]
        detector_logits, descriptors, stability_logits = self._compiled(seen)
        with torch.autocast(descriptors.device.type, enabled=False):
            first, second = functional.normalize(descriptors.float(), dim=1).chunk(2)
            points_a, points_b = batch["points_a"], batch["points_b"]
            a, b = sample_descriptors(first, points_a), sample_descriptors(second, points_b)
            scale = self.log_scale.exp().clamp(max=100)
            descriptor = info_nce_loss(
                a, b, points_a, points_b, batch["valid"], scale, settings.masked_pixels,
                negative=batch.get("negative"), group=math.gcd(settings.pairs.group, len(a)), scenes=batch["scenes"],
                negative_b=batch.get("negative_b"),
            )  # fmt: skip
            total, result = settings.descriptor_weight * descriptor, {"descriptor": descriptor}
            if detector_logits is not None:
                detector = held_loss(detector_logits, batch["detector"])
                total, result["detector"] = total + settings.detector_weight * detector, detector
            if stability_logits is not None and "stability" in batch:
                stability = held_loss(stability_logits[:: settings.stability_every], batch["stability"])
                total = total + settings.stability_weight * stability
                result["stability"] = stability
        if "elsewhere" in batch:
            elsewhere = self._elsewhere(batch)
            total, result["elsewhere"] = total + settings.elsewhere.weight * elsewhere, elsewhere
        with torch.no_grad():
            right = self._recognised(a, b, batch["valid"])
        correspondences = batch["valid"].sum(dim=1).float().mean()
        return {"loss": total, **result, "right": right, "scale": scale, "correspondences": correspondences}

    def _elsewhere(self, batch: dict[str, Tensor]) -> Tensor:
        """How far all heads are from what they are held to on pictures of other places; see `HeldElsewhere`."""
        detector_logits, descriptors, stability_logits = self._heads(batch["elsewhere"])
        with torch.autocast(descriptors.device.type, enabled=False):
            own = sample_descriptors(descriptors.float(), batch["elsewhere_points"].float())
            moved = ((own - batch["elsewhere_descriptors"].float()) ** 2).sum(dim=-1).mean()
            if detector_logits is not None:
                moved = moved + held_loss(detector_logits, batch["elsewhere_detector"])
            if stability_logits is not None and "elsewhere_stability" in batch:
                moved = moved + held_loss(stability_logits, batch["elsewhere_stability"])
        return moved

    def _heads(self, seen: Tensor) -> tuple[Tensor | None, Tensor, Tensor | None]:
        """Of images, or of what the frozen layers make of them; None for heads that need not be held."""
        shared = self.network.encode(seen, self.settings.frozen_layers)
        if self.settings.holds_by_itself:
            return None, self.network.descriptor(shared), None
        stability = None if self.network.stability is None else self.network.stability(shared)
        return self.network.detector(shared), self.network.descriptor(shared), stability

    @staticmethod
    def _recognised(a: Tensor, b: Tensor, valid: Tensor) -> Tensor:
        """Share of the points of view a whose partner is the nearest of its pair's, for a sixteenth of the pairs."""
        a, b, valid = a[::16], b[::16], valid[::16]
        similarity = (a @ b.transpose(1, 2)).masked_fill(~valid[:, None], -2.0)
        found = similarity.argmax(dim=2) == torch.arange(a.shape[1], device=a.device)
        return (found & valid).sum() / valid.sum().clamp(min=1)
