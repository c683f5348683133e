"""The runtime where OpenVINO is not to be had: the same network in ONNX Runtime."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from improvo.errors import imported
from improvo.frontend.decoding import NetworkMaps
from improvo.frontend.int8 import IMAGE_COPIES, WEIGHT_MAX, weight_max
from improvo.frontend.onnx_graph import NetworkNodes, OnnxGraph, add_heat_map, rounded, rounded_weight
from improvo.frontend.weights_files import Weights
from improvo.types import Float32

_FEATURE = "the ONNX runtime"
onnxruntime = imported("onnxruntime", _FEATURE, "onnxruntime")
_ERRORS_ONLY = 3  # severity of its log


class OnnxRuntime:
    """Runs a network on the CPU with ONNX Runtime; arguments as `OpenVinoRuntime`. Several threads may call it."""

    def __init__(self, weights: Weights, int8: bool = False, threads: int = 0) -> None:
        self.name = "onnxruntime-int8" if int8 else "onnxruntime-float32"
        graph = OnnxGraph(_FEATURE)
        ranges = weights.card.activation_ranges if int8 else {}
        heads = NetworkNodes(graph, weights, ranges, weight_max(int8 and loses_large_products())).add("image")
        outputs = {add_heat_map(graph, heads.pop("detector")): [None] * 4}
        outputs |= {graph.node("Transpose", node, perm=[0, 2, 3, 1]): [None] * 4 for node in heads.values()}
        self._session = _session(graph, outputs, threads)

    def __call__(self, images: Float32) -> NetworkMaps:
        """Maps of (B, 1, H, W) images in [0, 1] with sides that are multiples of 8."""
        maps = self._session.run(None, {"image": np.ascontiguousarray(images, np.float32)})
        return NetworkMaps(maps[0][:, 0], maps[1], maps[2] if len(maps) > 2 else None)


def activation_ranges(weights: Weights, images: Float32, quantile: float) -> dict[str, float]:
    """The `quantile` of what each convolution reads over (B, 1, H, W) images, by the name of the one that reads it."""
    graph = OnnxGraph(_FEATURE)
    nodes = NetworkNodes(graph, weights)
    nodes.add("image")
    found = _session(graph, {node: [None] * 4 for node in nodes.read.values()}, 0).run(None, {"image": images})
    return {reader: float(np.quantile(values, quantile)) for reader, values in zip(nodes.read, found, strict=True)}


@cache
def loses_large_products() -> bool:
    """Whether eight bits are added up in too few bits here (see `int8.py`): 4 · 1 · 1 is not 4 then."""
    graph = OnnxGraph(_FEATURE)
    image = rounded(graph, graph.node("Concat", *["image"] * IMAGE_COPIES, axis=1), 1.0)
    ones = rounded_weight(graph, np.ones((IMAGE_COPIES, IMAGE_COPIES, 3, 3), np.float32), WEIGHT_MAX)
    expected = float(IMAGE_COPIES * 9)
    conv = graph.node("Conv", image, ones, graph.constant(np.zeros(IMAGE_COPIES, np.float32)), pads=[0] * 4)
    product = rounded(graph, graph.node("Relu", conv), expected)  # only what is rounded again is added in eight bits
    found = _session(graph, {product: [None] * 4}, 1).run(None, {"image": np.ones((1, 1, 16, 16), np.float32)})
    return bool(found[0].min() < 0.99 * expected)


def _session(graph: OnnxGraph, outputs: Mapping[str, list[Any]], threads: int) -> Any:
    onnxruntime.disable_telemetry_events()  # builds for Windows have some
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = _ERRORS_ONLY
    model = graph.model("network", {name: (False, shape) for name, shape in outputs.items()})
    return onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
