"""The network in torch, for training and for the torch runtime (paper, "Convolutional Frontend"; extra `train`)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from improvo.frontend.architecture import CELL, POOL_AFTER, Architecture


class NetworkOutput(NamedTuple):
    """What one forward pass gives, raw. Hc = H / 8, Wc = W / 8; the cell (i, j) is centred on (8j + 3.5, 8i + 3.5)."""

    detector_logits: Tensor  # (B, 65, Hc, Wc); channel 8·row + column of the pixel in its cell, 64 is the dustbin
    descriptors: Tensor  # (B, D, Hc, Wc), not normalised
    stability_logits: Tensor | None  # (B, 2, Hc, Wc), channel 1 is "stable"; None without a stability head


class SuperPoint(nn.Module):
    """SuperPoint with the paper's stability head: one encoder, three heads, one forward pass.

    Args:
        architecture: widths and order of the layers (`improvo.frontend.architecture.ARCHITECTURES["superpoint"]`).
        batch_norm: build the batch norm that the architecture names; False leaves it out (folded weights).

    Parameters are named `encoder.N`, `detector.N`, `descriptor.N`, `stability.N`, each with `.convolution` and, on the
    3×3 ones, `.norm`. `state_dict()` is what a weights file holds (`improvo.frontend.weights_files`); inference folds
    the norm.
    """

    def __init__(self, architecture: Architecture, batch_norm: bool = True) -> None:
        super().__init__()
        self.architecture = architecture if batch_norm else architecture.without_normalisation()
        groups: dict[str, list[nn.Module]] = {}
        for layer in self.architecture.convolutions():
            block = _Block(layer.inputs, layer.outputs, layer.kernel, self.architecture)
            groups.setdefault(layer.name.partition(".")[0], []).append(block)
        self.encoder = nn.ModuleList(groups["encoder"])
        self.detector = nn.Sequential(*groups["detector"])
        self.descriptor = nn.Sequential(*groups["descriptor"])
        self.stability = nn.Sequential(*groups["stability"]) if "stability" in groups else None

    def forward(self, image: Tensor) -> NetworkOutput:
        """Run the network.

        Args:
            image: (B, 1, H, W) float in [0, 1], H and W multiples of 8.

        Raises:
            ValueError: a side that is no multiple of 8.
        """
        if image.shape[-1] % CELL or image.shape[-2] % CELL:
            raise ValueError(f"image sides must be multiples of {CELL}, not {tuple(image.shape[-2:])}")
        shared = self.encode(image)
        stability = None if self.stability is None else self.stability(shared)
        return NetworkOutput(self.detector(shared), self.descriptor(shared), stability)

    def encode(self, image: Tensor, first: int = 0, last: int = 8) -> Tensor:
        """The features that the heads share, (B, F, Hc, Wc), of `image` (B, 1, H, W).

        Args:
            image: or, where `first` is not 0, what the layers before `first` make of it.
            first: layer to begin with.
            last: layer to end before; the features are those of the layers up to it.
        """
        shared = image
        for position in range(first, last):  # at H×W, H/2×W/2, H/4×W/4, H/8×W/8: two convolutions each
            shared = self.encoder[position](shared)
            if position in POOL_AFTER:
                shared = functional.max_pool2d(shared, 2)
        return shared


class _Block(nn.Module):
    """3×3 convolution, batch norm and ReLU in the architecture's order; or a bare 1×1 convolution."""

    def __init__(self, inputs: int, outputs: int, kernel: int, architecture: Architecture) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(inputs, outputs, kernel, padding=kernel // 2)
        self.activated = kernel > 1
        self.norm_first = architecture.normalisation == "before_relu"
        normalised = self.activated and architecture.normalisation != "none"
        self.norm = nn.BatchNorm2d(outputs, eps=architecture.norm_epsilon) if normalised else None

    def forward(self, x: Tensor) -> Tensor:
        x = self.convolution(x)
        if not self.activated:
            return x
        if self.norm is None:
            return functional.relu(x)
        if self.norm_first:
            return functional.relu(self.norm(x))
        return self.norm(functional.relu(x))


def heat_map(detector_logits: Tensor) -> Tensor:
    """Keypoint probability of every pixel (B, H, W) from (B, 65, Hc, Wc): softmax, dustbin dropped, cells laid out."""
    probabilities = functional.softmax(detector_logits, dim=1)[:, :-1]
    return functional.pixel_shuffle(probabilities, CELL).squeeze(1)


def sample(cells: Tensor, keypoints: Tensor) -> Tensor:
    """Bilinear values of a map of cells at pixels; outside the outermost cell centres the border value holds.

    Args:
        cells: (B, C, Hc, Wc).
        keypoints: (B, N, 2) x, y in pixels of the image (not of the cells).

    Returns:
        (B, N, C)
    """
    sides = cells.shape[-1] * CELL, cells.shape[-2] * CELL
    # with align_corners=False, -1 and 1 are the image's outer edges
    grid = torch.stack([(keypoints[..., axis] + 0.5) / side * 2 - 1 for axis, side in enumerate(sides)], dim=-1)
    values = functional.grid_sample(cells, grid[:, None], mode="bilinear", padding_mode="border", align_corners=False)
    return values[:, :, 0].transpose(1, 2)


def sample_descriptors(descriptors: Tensor, keypoints: Tensor) -> Tensor:
    """Unit descriptors (B, N, D) at `keypoints` (B, N, 2): cells normalised, sampled bilinearly, normalised again."""
    return functional.normalize(sample(functional.normalize(descriptors, dim=1), keypoints), dim=-1)


def sample_stability(stability_logits: Tensor, keypoints: Tensor) -> Tensor:
    """Logits (B, N, 2) at `keypoints` (B, N, 2): bilinear, as the paper interpolates before its softmax."""
    return sample(stability_logits, keypoints)
