"""The default runtime: the network as an OpenVINO graph, built from the weights file without torch or ONNX."""

from __future__ import annotations

from typing import Any

import numpy as np
import openvino as ov
from openvino import opset13 as ops

from sivo.frontend.architecture import CELL, POOL_AFTER
from sivo.frontend.runtime import NetworkMaps
from sivo.frontend.weights import FoldedLayer, Weights
from sivo.types import Float32

INT8_ACTIVATION_LEVELS = 256  # unsigned: the inputs of all quantised layers come out of a ReLU
INT8_WEIGHT_LEVELS = 255  # signed and symmetric


class OpenVinoRuntime:
    """Runs a network on the CPU with OpenVINO.

    Args:
        weights: of any architecture.
        int8: quantise the 3×3 convolutions but the first, by the activation ranges of the model card. The first, which
            sees the image, and the last 1×1 of each head stay in float32: quantised, they cost a quarter of the
            keypoints and gain no time.
        threads: 0 for as many as the machine has.

    One graph is compiled for each image size and kept. Not to be called from several threads at once.
    """

    def __init__(self, weights: Weights, int8: bool = False, threads: int = 0) -> None:
        self.name = "openvino-int8" if int8 else "openvino-float32"
        self._graph = _Graph(weights, weights.card.activation_ranges if int8 else {})
        # Left to itself, OpenVINO may compute in bfloat16 and in several streams: other numbers on other machines.
        self._options: dict[str, Any] = {"INFERENCE_PRECISION_HINT": "f32", "NUM_STREAMS": 1}
        if threads:
            self._options["INFERENCE_NUM_THREADS"] = threads
        self._core = ov.Core()
        self._requests: dict[tuple[int, ...], Any] = {}

    def __call__(self, images: Float32) -> NetworkMaps:
        """Maps of (B, 1, H, W) images in [0, 1] with sides that are multiples of 8."""
        request = self._requests.get(images.shape)
        if request is None:
            compiled = self._core.compile_model(self._graph.model(images.shape), "CPU", self._options)
            request = self._requests[images.shape] = compiled.create_infer_request()
        maps = request.infer([images], share_inputs=True, share_outputs=True)
        return NetworkMaps(maps[0][:, 0], maps[1], maps[2] if len(maps) > 2 else None)


def activation_ranges(weights: Weights, images: Float32, quantile: float) -> dict[str, float]:
    """The `quantile` of each quantised convolution's inputs over (B, 1, H, W) images, by the convolution's name."""
    graph = _Graph(weights, {})
    model = graph.model(images.shape, taps=True)
    found = ov.Core().compile_model(model, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})([images])
    return {name: float(np.quantile(found[position], quantile)) for position, name in enumerate(graph.tapped)}


class _Graph:
    """Builds the network's graph, layer by layer."""

    def __init__(self, weights: Weights, ranges: dict[str, float]) -> None:
        self._layers = {layer.convolution.name: layer for layer in weights.folded()}
        self._heads = weights.architecture.heads
        self._ranges = ranges
        self.tapped = [f"encoder.{layer}" for layer in range(1, 8)] + [_SHARED]

    def model(self, shape: tuple[int, ...], taps: bool = False) -> Any:
        """The model for images of `shape` (B, 1, H, W); with `taps`, it puts out the inputs of `tapped` instead."""
        image = ops.parameter(list(shape), np.float32, name="image")
        inputs = []
        node = image
        for position in range(8):
            node = self._convolution(f"encoder.{position}", node)
            # Quantised before the pool, which is then done in eight bits too.
            following = f"encoder.{position + 1}" if position < 7 else _SHARED
            node = self._quantised(following, node)
            if position in POOL_AFTER:
                node = ops.max_pool(node, [2, 2], [1, 1], [0, 0], [0, 0], [2, 2]).output(0)
            inputs.append(node)
        if taps:
            return _model(inputs, image)
        heads = {name: self._convolution(f"{name}.1", self._convolution(f"{name}.0", node)) for name in self._heads}
        outputs = [_heat_map(heads.pop("detector"))]
        outputs += [ops.transpose(head, np.array([0, 2, 3, 1])) for head in heads.values()]  # cell by cell
        return _model(outputs, image)

    def _convolution(self, name: str, node: Any) -> Any:
        layer = self._layers[name]
        pad = layer.convolution.kernel // 2
        node = ops.convolution(node, self._weight(layer), [1, 1], [pad, pad], [pad, pad], [1, 1])
        node = ops.add(node, _channels(layer.bias))
        if layer.convolution.kernel == 1:
            return node
        node = ops.relu(node)
        if layer.scale is not None and layer.shift is not None:
            node = ops.add(ops.multiply(node, _channels(layer.scale)), _channels(layer.shift))
        return node

    def _weight(self, layer: FoldedLayer) -> Any:
        weight = ops.constant(layer.weight)
        name = layer.convolution.name
        if not self._ranges or name == "encoder.0" or layer.convolution.kernel == 1:
            return weight
        limit = np.abs(layer.weight).max(axis=(1, 2, 3), keepdims=True)
        low, high = ops.constant(-limit), ops.constant(limit)
        return ops.fake_quantize(weight, low, high, low, high, INT8_WEIGHT_LEVELS)

    def _quantised(self, name: str, node: Any) -> Any:
        if not self._ranges:
            return node
        low, high = ops.constant(np.float32(0)), ops.constant(np.float32(self._ranges[name]))
        return ops.fake_quantize(node, low, high, low, high, INT8_ACTIVATION_LEVELS)


_SHARED = "heads"  # the encoder's output, which every head's first convolution reads


def _heat_map(logits: Any) -> Any:
    probabilities = ops.softmax(logits, 1)
    first, last, step, axis = (ops.constant(np.array([value])) for value in (0, CELL * CELL, 1, 1))
    return ops.depth_to_space(ops.slice(probabilities, first, last, step, axis), "blocks_first", CELL)


def _channels(values: Float32) -> Any:
    return ops.constant(values.reshape(1, -1, 1, 1))


def _model(outputs: list[Any], image: Any) -> Any:
    return ov.Model([ops.result(node) for node in outputs], [image])
