"""Small networks for tests: random ones, and two made by hand whose answer is known to the pixel."""

from __future__ import annotations

from itertools import product

import numpy as np

from improvo.frontend.architecture import Architecture
from improvo.frontend.weights_files import ModelCard, Weights, expected_shapes
from improvo.types import Float32

TINY = Architecture("tiny", encoder=(4, 4, 6, 6, 8, 8, 8, 8), head=12, descriptor=16)


def random_weights(architecture: Architecture = TINY, seed: int = 0, contrast: float = 30.0) -> Weights:
    """Random weights that keep the variance; `contrast` widens the detector's logits, so that scores do not tie."""
    random = np.random.default_rng(seed)
    tensors: dict[str, Float32] = {}
    for name, shape in expected_shapes(architecture).items():
        if name.endswith(("running_var", "norm.weight")):
            values = random.uniform(0.5, 1.5, shape)
        else:
            values = random.normal(0, 0.1 if len(shape) == 1 else np.sqrt(2 / np.prod(shape[1:])), shape)
        tensors[name] = (values * (contrast if name == "detector.1.convolution.weight" else 1)).astype(np.float32)
    return Weights(ModelCard(architecture, "none"), tensors)


def lit_pixel_weights() -> Weights:
    """A network whose keypoints are the white pixels of a black image, at least 16 pixels apart.

    Pooling forgets where in a 2×2 block a pixel was. Four copies, shifted by 0 or 1 in x and y, are pooled each, and
    which of them kept the pixel tells where it was. Three times over, that makes one channel for each pixel of a cell.
    """
    architecture = Architecture("lit-pixel", (1, 4, 4, 16, 16, 64, 64, 64), 64, 64, normalisation="none")
    tensors = {name: np.zeros(shape, np.float32) for name, shape in expected_shapes(architecture).items()}

    def weight(layer: str) -> Float32:
        return tensors[f"{layer}.convolution.weight"]

    places = list(product((0, 1), (0, 1)))  # y, x: of a copy's shift, or of a pixel in its block
    for stage in range(3):
        groups = 4**stage
        for group, (copy, (shift_y, shift_x)) in product(range(groups), enumerate(places)):
            weight(f"encoder.{2 * stage + 1}")[4 * group + copy, group, 1 - shift_y, 1 - shift_x] = 1
            for place, (y, x) in enumerate(places):
                kept = shift_y <= 1 - y and shift_x <= 1 - x  # the copy keeps a pixel of this place in its block
                weight(f"encoder.{2 * stage + 2}")[4 * group + place, 4 * group + copy, 1, 1] = 1 if kept else -1
        bias = tensors[f"encoder.{2 * stage + 2}.convolution.bias"]
        bias[:] = np.tile([1.0 - (2 - y) * (2 - x) for y, x in places], groups)
    weight("encoder.0")[0, 0, 1, 1] = 1
    for layer in ("encoder.7", "detector.0", "descriptor.0", "stability.0"):
        weight(layer)[range(64), range(64), 1, 1] = 1
    for channel, bits in enumerate(product(places, repeat=3)):  # the pixel's lowest bits first
        y, x = (sum(bits[stage][axis] << stage for stage in range(3)) for axis in (0, 1))
        weight("detector.1")[8 * y + x, channel] = 20
        weight("descriptor.1")[8 * y + x, channel] = 1
    tensors["detector.1.convolution.bias"][64] = 10
    tensors["descriptor.1.convolution.bias"][:] = 0.1
    return Weights(ModelCard(architecture, "none"), tensors)


def brightness_weights() -> Weights:
    """A network whose stability logit is the brightest value of a cell of the image."""
    architecture = Architecture("brightness", (1,) * 8, 1, 1, normalisation="none")
    tensors = {name: np.zeros(shape, np.float32) for name, shape in expected_shapes(architecture).items()}
    for layer in (*(f"encoder.{position}" for position in range(8)), "stability.0"):
        tensors[f"{layer}.convolution.weight"][0, 0, 1, 1] = 1
    tensors["stability.1.convolution.weight"][1, 0] = 1
    return Weights(ModelCard(architecture, "none"), tensors)
