"""Channels that are always zero: left out when a network runs or is trained, put back when its weights are saved.

The first layers work on the most pixels: in `superpoint` the first four, 64 channels wide, take three fifths of all
multiplications. Weights may leave some of those channels unused, their filters, biases and batch norm all zero. The
file then still has the paper's shapes, and other programs can run it. Without these channels it computes the same in
less time. Training keeps them at zero, because a ReLU at zero passes neither a value nor a gradient.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from improvo.frontend.architecture import Architecture
from improvo.frontend.weights_files import Weights, expected_shapes
from improvo.types import Float32

_ZERO_IN_A_DEAD_CHANNEL = ("convolution.weight", "convolution.bias", "norm.weight", "norm.bias")


def without_dead_channels(weights: Weights) -> Weights:
    """The same function with the encoder's dead channels left out; the card then has the narrower architecture."""
    full = weights.architecture
    alive = [_alive(weights, f"encoder.{layer}") for layer in range(len(full.encoder))]
    if all(channels.all() for channels in alive):
        return weights
    outputs = {f"encoder.{layer}": channels for layer, channels in enumerate(alive)}
    inputs = {f"encoder.{layer + 1}": channels for layer, channels in enumerate(alive[:-1])}
    inputs |= {f"{head}.0": alive[-1] for head in full.heads}
    tensors = {}
    for name, values in weights.tensors.items():
        layer = ".".join(name.split(".")[:2])
        if layer in outputs:
            values = values[outputs[layer]]
        if layer in inputs and values.ndim == 4:
            values = values[:, inputs[layer]]
        tensors[name] = np.ascontiguousarray(values)
    narrow = replace(full, encoder=tuple(int(channels.sum()) for channels in alive))
    return Weights(replace(weights.card, architecture=narrow), tensors)


def with_dead_channels(tensors: Mapping[str, Float32], target: Architecture) -> dict[str, Float32]:
    """Tensors of a wider network that computes the same: channels are added that are always zero.

    Args:
        tensors: of a network that is nowhere wider than `target`.
    """
    wide = {}
    for name, shape in expected_shapes(target).items():
        values = np.ones(shape, np.float32) if name.endswith("running_var") else np.zeros(shape, np.float32)
        values[tuple(slice(size) for size in tensors[name].shape)] = tensors[name]
        wide[name] = values
    return wide


def _alive(weights: Weights, layer: str) -> NDArray[np.bool_]:
    """(C,) whether an output channel of the layer can be other than zero; one is kept where none can."""
    alive = np.zeros(weights.tensors[f"{layer}.convolution.bias"].shape, np.bool_)
    for part in _ZERO_IN_A_DEAD_CHANNEL:
        values = weights.tensors.get(f"{layer}.{part}")
        if values is not None:
            alive |= values.reshape(len(alive), -1).any(axis=1)
    alive[0] |= not alive.any()
    return alive
