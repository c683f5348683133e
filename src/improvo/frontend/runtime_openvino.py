"""The default runtime: the network as an OpenVINO graph, built from the weights file without torch or ONNX."""

from __future__ import annotations

import threading
from functools import cache
from typing import Any

import numpy as np

from improvo.frontend.architecture import CELL, POOL_AFTER
from improvo.frontend.decoding import NetworkMaps
from improvo.frontend.int8 import (
    ACTIVATION_MAX,
    IMAGE_COPIES,
    LAST_LAYERS,
    WEIGHT_MAX,
    in_eight_bits,
    largest_of_channels,
    spread_over_copies,
    weight_max,
)
from improvo.frontend.openvino_library import CORE, plain_letters
from improvo.frontend.openvino_library import openvino as ov
from improvo.frontend.openvino_library import opset13 as ops
from improvo.frontend.weights_files import Weights
from improvo.types import Float32

_KEPT_SIZES = 4
_PROBED = (1, 4, 16, 16)  # shape of what is multiplied to see whether large products are lost


class OpenVinoRuntime:
    """Runs a network on the CPU with OpenVINO.

    Args:
        weights: of any architecture.
        int8: compute all but the detector's and the stability head's last layer in eight bits, by the activation
            ranges of the model card.
        threads: 0 for as many as the machine has.

    A graph is compiled for each image size; those of the last few sizes are kept. Each thread has its own request, so
    that several may call it; what it returns holds until the same thread calls it again.
    """

    def __init__(self, weights: Weights, int8: bool = False, threads: int = 0) -> None:
        self.name = "openvino-int8" if int8 else "openvino-float32"
        self._graph = _Graph(weights, weights.card.activation_ranges if int8 else {})
        # Left to itself, OpenVINO may compute in bfloat16 and in several streams: other numbers on other machines.
        # Pinned threads of several processes would all be on the first cores.
        self._options: dict[str, Any] = {
            "INFERENCE_PRECISION_HINT": "f32",
            "NUM_STREAMS": 1,
            "ENABLE_CPU_PINNING": False,
        }
        if threads:
            self._options["INFERENCE_NUM_THREADS"] = threads
        self._compiled: dict[tuple[int, ...], Any] = {}
        self._compiling = threading.Lock()
        self._own = threading.local()  # `requests`: by image size, of one thread

    def __call__(self, images: Float32) -> NetworkMaps:
        """Maps of (B, 1, H, W) images in [0, 1] with sides that are multiples of 8."""
        requests: dict[tuple[int, ...], Any] = self._own.__dict__.setdefault("requests", {})
        request = requests.get(images.shape)
        if request is None:
            request = _kept(requests, images.shape, self._compiled_for(images.shape).create_infer_request())
        maps = request.infer([images], share_inputs=True, share_outputs=True)
        return NetworkMaps(maps[0][:, 0], maps[1], maps[2] if len(maps) > 2 else None)

    def _compiled_for(self, shape: tuple[int, ...]) -> Any:
        with self._compiling:
            found = self._compiled.get(shape)
            if found is None:
                with plain_letters():
                    compiled = CORE.compile_model(self._graph.model(shape), "CPU", self._options)
                found = _kept(self._compiled, shape, compiled)
            return found


def _kept(cache: dict[tuple[int, ...], Any], shape: tuple[int, ...], value: Any) -> Any:
    """The value, kept by its size; the oldest makes room."""
    while len(cache) >= _KEPT_SIZES:
        cache.pop(next(iter(cache)), None)
    cache[shape] = value
    return value


def activation_ranges(weights: Weights, images: Float32, quantile: float) -> dict[str, float]:
    """The `quantile` of what each convolution reads over (B, 1, H, W) images, by the name of the one that reads it."""
    graph = _Graph(weights, {})
    with plain_letters():
        compiled = CORE.compile_model(graph.model(images.shape, taps=True), "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    found = compiled([images])
    return {reader: float(np.quantile(found[position], quantile)) for position, reader in enumerate(graph.readers)}


@cache
def loses_large_products() -> bool:
    """Whether eight bits are added up in too few bits here (see `int8.py`): 4 · 1 · 1 is not 4 then. It takes 50 ms."""
    with plain_letters():
        image = ops.parameter(list(_PROBED), np.float32, name="image")
        ones = _quantised_weight(np.ones((4, 4, 3, 3), np.float32), WEIGHT_MAX)
        node = ops.relu(ops.convolution(_rounded(image, 1.0), ones, [1, 1], [0, 0], [0, 0], [1, 1]))
        compiled = CORE.compile_model(_model([node.output(0)], image), "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    return bool(compiled([np.ones(_PROBED, np.float32)])[0].min() < 0.99 * 4 * 9)


class _Graph:
    """Builds the network's graph, layer by layer.

    Activations are quantised where the layer that reads them is: `ranges` has their largest value by that layer's name
    (`heads` for what the heads share), and is empty for float32.
    """

    def __init__(self, weights: Weights, ranges: dict[str, float]) -> None:
        self._layers = {layer.convolution.name: layer for layer in weights.folded()}
        self._heads = weights.architecture.heads
        self._ranges = {**ranges, "encoder.0": 1.0} if ranges else {}
        self._weight_max = weight_max(bool(ranges) and loses_large_products())
        self.readers = [*(f"encoder.{layer}" for layer in range(1, 8)), "heads", *(f"{head}.1" for head in self._heads)]

    def model(self, shape: tuple[int, ...], taps: bool = False) -> Any:
        """The model for images of `shape` (B, 1, H, W); with `taps`, it puts out what each of `readers` reads."""
        image = ops.parameter(list(shape), np.float32, name="image")
        read: dict[str, Any] = {}
        node = self._quantised("encoder.0", image)
        for position in range(8):
            node = self._convolution(f"encoder.{position}", node)
            reader = f"encoder.{position + 1}" if position < 7 else "heads"
            node = self._quantised(reader, node)  # before the pool, which is then done in eight bits too
            if position in POOL_AFTER:
                node = ops.max_pool(node, [2, 2], [1, 1], [0, 0], [0, 0], [2, 2]).output(0)
            read[reader] = node
        heads: dict[str, Any] = {}
        for head in self._heads:
            reader = f"{head}.1"
            read[reader] = self._convolution(f"{head}.0", node)
            if reader in LAST_LAYERS:
                read[reader] = self._quantised(reader, read[reader])
            heads[head] = self._convolution(reader, read[reader])
        if taps:
            return _model([read[reader] for reader in self.readers], image)
        outputs = [_heat_map(heads.pop("detector"))]
        outputs += [ops.transpose(head, np.array([0, 2, 3, 1])) for head in heads.values()]  # cell by cell
        return _model(outputs, image)

    def _convolution(self, name: str, node: Any) -> Any:
        layer = self._layers[name]
        weight = ops.constant(layer.weight)
        if self._ranges and name == "encoder.0":
            node = ops.concat([node] * IMAGE_COPIES, axis=1)
            weight = _quantised_weight(spread_over_copies(layer.weight, self._weight_max), self._weight_max)
        elif self._ranges and in_eight_bits(name, layer.convolution.kernel):
            weight = _quantised_weight(layer.weight, self._weight_max)
        pad = layer.convolution.kernel // 2
        node = ops.convolution(node, weight, [1, 1], [pad, pad], [pad, pad], [1, 1])
        node = ops.add(node, _channels(layer.bias))
        if layer.convolution.kernel == 1:
            return node
        node = ops.relu(node)
        if layer.scale is not None and layer.shift is not None:
            node = ops.add(ops.multiply(node, _channels(layer.scale)), _channels(layer.shift))
        return node

    def _quantised(self, reader: str, node: Any) -> Any:
        return _rounded(node, self._ranges[reader]) if self._ranges else node


def _rounded(node: Any, largest: float) -> Any:
    """To 256 values from zero on; unsigned, since nothing is negative behind a ReLU."""
    low, high = ops.constant(np.float32(0)), ops.constant(np.float32(largest))
    return ops.fake_quantize(node, low, high, low, high, ACTIVATION_MAX + 1)


def _quantised_weight(weight: Float32, largest: int) -> Any:
    """Signed and symmetric, with one step for each output channel; `largest` stands for its largest weight."""
    # OpenVINO computes 255 values in eight bits, but fewer in float32; so the range is wider than the weights instead
    limit = largest_of_channels(weight) * np.float32(WEIGHT_MAX / largest)
    low, high = ops.constant(-limit), ops.constant(limit)
    return ops.fake_quantize(ops.constant(weight), low, high, low, high, 2 * WEIGHT_MAX + 1)


def _heat_map(logits: Any) -> Any:
    probabilities = ops.softmax(logits, 1)
    first, last, step, axis = (ops.constant(np.array([value])) for value in (0, CELL * CELL, 1, 1))
    return ops.depth_to_space(ops.slice(probabilities, first, last, step, axis), "blocks_first", CELL)


def _channels(values: Float32) -> Any:
    return ops.constant(values.reshape(1, -1, 1, 1))


def _model(outputs: list[Any], image: Any) -> Any:
    return ov.Model([ops.result(node) for node in outputs], [image])
