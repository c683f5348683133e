"""The network as an ONNX graph, layer by layer: for ONNX Runtime, and as the first part of `improvo export onnx`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from improvo.errors import imported
from improvo.frontend.architecture import CELL, POOL_AFTER
from improvo.frontend.int8 import (
    ACTIVATION_MAX,
    IMAGE_COPIES,
    LAST_LAYERS,
    WEIGHT_MAX,
    in_eight_bits,
    largest_of_channels,
    spread_over_copies,
)
from improvo.frontend.weights_files import FoldedLayer, Weights
from improvo.types import Float32

OPSET = 17
IMAGE = ("batch", 1, "height", "width")
IR_VERSION = 8  # the oldest that holds this opset: readable by ONNX Runtime 1.13 and later


class OnnxGraph:
    """Collects nodes and constants; `node` and `constant` return the name of what they add.

    Args:
        feature: what needs the package onnx, for the message where it is missing.

    Raises:
        MissingExtraError: the package onnx is not installed.
    """

    def __init__(self, feature: str) -> None:
        self._onnx = imported("onnx", feature, "onnx")
        self._helper, self._numpy_helper = self._onnx.helper, self._onnx.numpy_helper
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def node(self, kind: str, *inputs: str, name: str | None = None, outputs: int = 1, **attributes: Any) -> Any:
        """Add a node; returns the name of its output, or a list of names."""
        names = [name or f"{kind}_{len(self.nodes)}"] if outputs == 1 else []
        names = names or [f"{kind}_{len(self.nodes)}_{number}" for number in range(outputs)]
        self.nodes.append(self._helper.make_node(kind, list(inputs), names, **attributes))
        return names[0] if outputs == 1 else names

    def constant(self, values: NDArray[Any] | Sequence[int]) -> str:
        """Add a tensor."""
        name = f"constant_{len(self.constants)}"
        self.constants.append(self._numpy_helper.from_array(np.asarray(values), name))
        return name

    def number(self, value: float) -> str:
        """Add a float32 scalar."""
        return self.constant(np.array(value, np.float32))

    def slice(self, node: str, axes: Sequence[int], starts: str, ends: str) -> str:
        """A part of a tensor, from the constants `starts` to `ends` along `axes`."""
        return str(self.node("Slice", node, starts, ends, self.constant(np.array(axes))))

    def model(
        self, name: str, outputs: Mapping[str, tuple[bool, list[Any]]], image: Sequence[int | str] = IMAGE
    ) -> Any:
        """The model that turns `image` into the outputs.

        Args:
            name: of the graph.
            outputs: by the name of a node's output, whether it is boolean (else float32), and its shape.
            image: the shape of the input.
        """
        float32, boolean = self._onnx.TensorProto.FLOAT, self._onnx.TensorProto.BOOL
        given = self._helper.make_tensor_value_info("image", float32, list(image))
        described = [
            self._helper.make_tensor_value_info(output, boolean if is_bool else float32, shape)
            for output, (is_bool, shape) in outputs.items()
        ]
        return self._helper.make_model(
            self._helper.make_graph(self.nodes, name, [given], described, self.constants),
            opset_imports=[self._helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
            producer_name="improvo",
        )


class NetworkNodes:
    """Adds the network's layers to a graph.

    Args:
        graph: to add to.
        weights: of any architecture.
        ranges: in eight bits, the largest activation by the name of the layer that reads it; empty for float32.
        largest: whole number that stands for a weight in eight bits.
    """

    def __init__(
        self,
        graph: OnnxGraph,
        weights: Weights,
        ranges: Mapping[str, float] | None = None,
        largest: int = WEIGHT_MAX,
    ) -> None:
        self._graph, self._largest = graph, largest
        self._layers = {layer.convolution.name: layer for layer in weights.folded()}
        self._heads = weights.architecture.heads
        self._ranges = {**ranges, "encoder.0": 1.0} if ranges else {}
        self.read: dict[str, str] = {}  # what a layer reads, before it is rounded

    def add(self, image: str) -> dict[str, str]:
        """Raw output of every head, by its name."""
        node = self._rounded("encoder.0", image)
        for position in range(8):
            reader = f"encoder.{position + 1}" if position < 7 else "heads"
            # rounded before the pool, which is then done in eight bits too
            node = self._rounded(reader, self._convolution(f"encoder.{position}", node))
            if position in POOL_AFTER:
                node = self._graph.node("MaxPool", node, kernel_shape=[2, 2], strides=[2, 2])
            self.read[reader] = node
        heads = {}
        for head in self._heads:
            last = f"{head}.1"
            self.read[last] = self._convolution(f"{head}.0", node)
            between = self._rounded(last, self.read[last]) if last in LAST_LAYERS else self.read[last]
            heads[head] = self._convolution(last, between)
        return heads

    def _convolution(self, name: str, node: str) -> str:
        layer, graph = self._layers[name], self._graph
        weight = layer.weight
        if self._ranges and name == "encoder.0":
            node = graph.node("Concat", *[node] * IMAGE_COPIES, axis=1)
            weight = spread_over_copies(weight, self._largest)
        eight_bits = bool(self._ranges) and in_eight_bits(name, layer.convolution.kernel)
        kernel = rounded_weight(graph, weight, self._largest) if eight_bits else graph.constant(weight)
        pad = layer.convolution.kernel // 2
        node = graph.node("Conv", node, kernel, graph.constant(layer.bias), pads=[pad] * 4)
        return node if layer.convolution.kernel == 1 else self._activated(layer, node)

    def _activated(self, layer: FoldedLayer, node: str) -> str:
        graph = self._graph
        node = graph.node("Relu", node)
        if layer.scale is not None and layer.shift is not None:
            node = graph.node("Mul", node, graph.constant(layer.scale.reshape(1, -1, 1, 1)))
            node = graph.node("Add", node, graph.constant(layer.shift.reshape(1, -1, 1, 1)))
        return node

    def _rounded(self, reader: str, node: str) -> str:
        return rounded(self._graph, node, self._ranges[reader]) if self._ranges else node


def rounded(graph: OnnxGraph, node: str, largest: float) -> str:
    """An activation, rounded to 256 values from zero to `largest`; unsigned: nothing is negative behind a ReLU."""
    scale, zero = graph.number(largest / ACTIVATION_MAX), graph.constant(np.array(0, np.uint8))
    return str(graph.node("DequantizeLinear", graph.node("QuantizeLinear", node, scale, zero), scale, zero))


def rounded_weight(graph: OnnxGraph, weight: Float32, largest: int) -> str:
    """A weight (O, I, k, k), rounded around zero with one step for each output channel.

    Args:
        graph: to add to.
        weight: of a convolution.
        largest: whole number that stands for the largest weight of a channel.
    """
    step = np.maximum(largest_of_channels(weight), 1e-30) / np.float32(largest)
    whole = np.clip(np.rint(weight / step), -largest, largest).astype(np.int8)
    steps, zeros = np.asarray(step.ravel(), np.float32), np.zeros(len(whole), np.int8)
    return str(graph.node("DequantizeLinear", *(graph.constant(values) for values in (whole, steps, zeros)), axis=0))


def add_heat_map(graph: OnnxGraph, logits: str) -> str:
    """Keypoint probability (B, 1, H, W) of every pixel from the detector's logits (B, 65, Hc, Wc)."""
    probabilities = graph.node("Softmax", logits, axis=1)
    pixels = graph.slice(probabilities, [1], graph.constant([0]), graph.constant([CELL * CELL]))
    return str(graph.node("DepthToSpace", pixels, blocksize=CELL, mode="DCR"))
