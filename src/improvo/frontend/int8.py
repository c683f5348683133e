"""Eight bits: which layers are computed in them, and how the first layer's weights are made to fit.

A runtime rounds activations to 256 values, from zero to the largest that the model card has for the layer that reads
them; and weights to 255 values around zero, with one step size for each output channel.

x86 processors without VNNI (before Ice Lake, and Zen 4) add two products in sixteen bits, and what is too large for
these becomes the largest number there is. On them weights are rounded to 127 values: then no two products are too
large. Whether a runtime needs that is found by a small product that would be (`loses_large_products` of each).
"""

from __future__ import annotations

import numpy as np

from improvo.types import Float32

ACTIVATION_MAX = 255
WEIGHT_MAX = 127
NARROW_WEIGHT_MAX = 63  # 2 · 255 · 63 < 2¹⁵
IMAGE_COPIES = 4
LAST_LAYERS = ("descriptor.1",)  # of the 1×1 convolutions; rounding the detector's moves keypoints


def in_eight_bits(name: str, kernel: int) -> bool:
    """Whether a convolution is computed in eight bits where the rest is."""
    return kernel > 1 or name in LAST_LAYERS


def largest_of_channels(weight: Float32) -> Float32:
    """(O, 1, 1, 1) the largest magnitude of each output channel of a weight (O, I, k, k)."""
    return np.asarray(np.abs(weight).max(axis=(1, 2, 3), keepdims=True), np.float32)


def weight_max(loses_large_products: bool) -> int:
    """The largest whole number that stands for a weight."""
    return NARROW_WEIGHT_MAX if loses_large_products else WEIGHT_MAX


def spread_over_copies(weight: Float32, largest: int = WEIGHT_MAX) -> Float32:
    """The first layer's weight (O, 1, 3, 3) as a sum over copies of the image (O, copies, 3, 3).

    Eight bits are too few for the weights of the first layer. Each weight is rounded to steps four times finer, and
    split into a sum over four copies of the image. Processors add products in groups of four, so the copies cost no
    time.

    Args:
        weight: of the first layer.
        largest: whole number that stands for a weight.
    """
    step = np.maximum(largest_of_channels(weight), 1e-30) / (largest * IMAGE_COPIES)
    whole, rest = np.divmod(np.rint(weight / step), IMAGE_COPIES)
    parts = whole + (np.arange(IMAGE_COPIES)[:, None, None] < rest)
    return np.asarray(parts * step, np.float32)
