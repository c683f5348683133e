"""Activation ranges for the int8 runtime, measured on pictures and kept in the model card."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from improvo.errors import InputError
from improvo.frontend.network import Image, prepare
from improvo.frontend.runtime import cpu_runtime
from improvo.frontend.weights_files import Weights


def calibrate(weights: Weights, images: Iterable[Image], quantile: float = 0.9999) -> Weights:
    """The weights with the largest activations over `images` in their card; the tensors stay as they are.

    Args:
        weights: without batch norm after the ReLU.
        images: a few dozen that look like what the network will see; of any size.
        quantile: of each image's activations; clipping the rarest leaves finer steps to the others.

    Raises:
        InputError: no images, or weights that int8 cannot run.
    """
    if cpu_runtime() == "openvino":
        from improvo.frontend.runtime_openvino import activation_ranges
    else:
        from improvo.frontend.runtime_onnxruntime import activation_ranges

    if weights.architecture.normalisation == "after_relu":
        raise InputError("int8 needs activations that are not negative: not for batch norm after the ReLU")
    ranges: dict[str, float] = {}
    for image in images:
        for name, value in activation_ranges(weights, prepare(image)[None, None], quantile).items():
            ranges[name] = max(ranges.get(name, 0.0), value)
    if not ranges:
        raise InputError("calibration needs at least one image; give a folder of pictures")
    return Weights(replace(weights.card, activation_ranges=ranges), weights.tensors)
