"""What a network that is not trained says of views: what another one is held to."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from improvo.frontend.channel_pruning import without_dead_channels
from improvo.frontend.runtime_torch import load_network
from improvo.frontend.weights_files import Weights


class Teacher(Protocol):
    """One head of a network."""

    def __call__(self, views: Tensor, layers: int = 0) -> tuple[Tensor, Tensor]:
        """Look at views.

        Args:
            views: (V, 1, H, W) in [0, 1].
            layers: of the encoder, whose features are wanted as well.

        Returns:
            Logits (V, C, Hc, Wc) float32, and the features (V, F, h, w) after so many layers; the views where it is 0.
        """


def network_teacher(weights: Weights, head: str, device: torch.device, precision: torch.dtype) -> Teacher:
    """One head (`detector` or `stability`) of the network with these weights, in evaluation mode."""
    network = load_network(without_dead_channels(weights)).requires_grad_(False)
    network = network.to(device, memory_format=torch.channels_last)
    chosen = getattr(network, head)

    def look(views: Tensor, layers: int = 0) -> tuple[Tensor, Tensor]:
        with torch.no_grad(), torch.autocast(device.type, torch.bfloat16, enabled=precision == torch.bfloat16):
            stem = network.encode(views, 0, layers)
            logits: Tensor = chosen(network.encode(stem, layers))
        return logits.float(), stem

    return look
