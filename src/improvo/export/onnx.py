"""A network with its decoding as one ONNX file, for programs that use ONNX Runtime, or OpenCV 5, without improvo."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from improvo import config, files
from improvo.frontend.architecture import CELL
from improvo.frontend.channel_pruning import without_dead_channels
from improvo.frontend.onnx_graph import NetworkNodes, OnnxGraph, add_heat_map
from improvo.frontend.settings import NetworkSettings
from improvo.frontend.weights_files import Weights


def export_onnx(weights: Weights, path: Path, settings: NetworkSettings, layout: str = "improvo") -> None:
    """Write an ONNX model that gives what `NetworkFrontend` gives, for a batch of images of any one size.

    Input `image` (batch, 1, height, width) float32 in [0, 1]. Outputs, with N = `settings.max_keypoints`:
    `keypoints` (batch, N, 2) x, y; `scores` (batch, N), best first; `descriptors` (batch, N, D); `stability` (batch, N)
    where there is such a head; `valid` (batch, N) bool, False on the rows past the last keypoint, which mean nothing.

    With the layout `opencv` it is what `cv2.ALIKED` of OpenCV 5 loads (`export/onnx_opencv.py`).

    Raises:
        MissingExtraError: the package onnx is not installed.
        OutputError: the file cannot be written.
    """
    graph = OnnxGraph("exporting ONNX")
    import onnx

    from improvo.export import onnx_opencv

    width = weights.architecture.descriptor
    for_opencv = layout == "opencv"
    image = onnx_opencv.grey(graph) if for_opencv else "image"
    outputs = _build(graph, without_dead_channels(weights), settings, image)
    shapes = onnx_opencv.SHAPES if for_opencv else _shapes(settings.max_keypoints)
    for name, node in (onnx_opencv.outputs(graph, outputs) if for_opencv else outputs).items():
        graph.node("Identity", node, name=name)
    described_outputs = {
        name: (name == "valid", [width if side == "width" else side for side in shapes[name]])
        for name in (shapes if for_opencv else outputs)
    }
    size: list[int | str] = [1, 3, "height", "width"] if for_opencv else ["batch", 1, "height", "width"]
    model = graph.model(weights.architecture.name, described_outputs, size)
    described = {"model_card": config.to_dict(weights.card), "settings": config.to_dict(settings)}
    onnx.helper.set_model_props(model, {name: json.dumps(value) for name, value in described.items()})
    onnx.checker.check_model(model, full_check=True)
    with files.written_atomically(path) as temporary:
        onnx.save(model, temporary)


def _shapes(count: int) -> dict[str, tuple[int | str, ...]]:
    """Of the outputs, by name; `width` is that of a descriptor."""
    shapes: dict[str, tuple[int | str, ...]] = {"keypoints": ("batch", count, 2)}
    shapes["descriptors"] = ("batch", count, "width")
    return shapes | dict.fromkeys(("scores", "stability", "valid"), ("batch", count))


def _build(graph: OnnxGraph, weights: Weights, settings: NetworkSettings, image: str) -> dict[str, str]:
    """The whole model from a grey `image` (batch, 1, height, width); the nodes of its outputs by name."""
    size = graph.slice(graph.node("Shape", image), [0], graph.constant([2]), graph.constant([4]))  # height, width
    width = graph.slice(size, [0], graph.constant([1]), graph.constant([2]))
    padding = graph.node("Mod", graph.node("Neg", size), graph.constant([CELL]))
    padded_size = graph.node("Add", size, padding)
    pads = graph.node("Concat", graph.constant([0] * 6), padding, axis=0)
    maps = NetworkNodes(graph, weights).add(graph.node("Pad", image, pads, mode="edge"))

    heat = graph.slice(add_heat_map(graph, maps["detector"]), [2, 3], graph.constant([0, 0]), size)
    scores, index = _best_pixels(graph, heat, size, settings)
    row, column = graph.node("Div", index, width), graph.node("Mod", index, width)
    pixels = [graph.node("Unsqueeze", axis, graph.constant([2])) for axis in (column, row)]
    keypoints = graph.node("Cast", graph.node("Concat", *pixels, axis=2), to=1)
    if settings.subpixel_radius:
        keypoints = graph.node("Add", keypoints, _offsets(graph, heat, size, index, settings.subpixel_radius))
    outputs = {"keypoints": str(keypoints), "scores": scores}
    grid = _sampling_grid(graph, keypoints, padded_size)
    cells = graph.node("LpNormalization", maps["descriptor"], axis=1, p=2)
    outputs["descriptors"] = graph.node("LpNormalization", _sample(graph, cells, grid), axis=2, p=2)
    if "stability" in maps:
        probabilities = graph.node("Softmax", _sample(graph, maps["stability"], grid), axis=2)
        stable = graph.slice(probabilities, [2], graph.constant([1]), graph.constant([2]))
        outputs["stability"] = graph.node("Squeeze", stable, graph.constant([2]))
    outputs["valid"] = graph.node("Greater", scores, graph.number(0))
    return outputs


def _best_pixels(graph: OnnxGraph, heat: str, size: str, settings: NetworkSettings) -> tuple[str, str]:
    """Scores (B, N) of the best local maxima and their position row · width + column, zero where there are no more."""
    radius, border = settings.nms_radius, settings.border
    window = 2 * radius + 1
    best = graph.node("MaxPool", heat, kernel_shape=[1, window], pads=[0, radius, 0, radius])
    best = graph.node("MaxPool", best, kernel_shape=[window, 1], pads=[radius, 0, radius, 0])
    above = graph.node("Greater", heat, graph.number(settings.threshold))
    kept = graph.node("And", graph.node("Equal", heat, best), above)
    scores = graph.node("Where", kept, heat, graph.number(0))
    if border:
        inner_end = graph.node("Sub", size, graph.constant([border]))
        inner = graph.slice(scores, [2, 3], graph.constant([border, border]), inner_end)
        scores = graph.node("Pad", inner, graph.constant([0, 0, border, border] * 2))
    # Padded by N zeros so that there are N to take from an image of any size.
    flat = graph.node("Pad", graph.node("Flatten", scores), graph.constant([0, 0, 0, settings.max_keypoints]))
    best_scores, index = graph.node("TopK", flat, graph.constant([settings.max_keypoints]), outputs=2, axis=1)
    last = graph.node("Sub", graph.node("ReduceProd", size, axes=[0]), graph.constant([1]))
    return best_scores, graph.node("Min", index, last)


def _offsets(graph: OnnxGraph, heat: str, size: str, index: str, radius: int) -> str:
    """Centre of mass of the heat map around the pixels at `index` (B, N), as offsets (B, N, 2)."""
    steps = np.arange(-radius, radius + 1, dtype=np.float32)
    y, x = np.meshgrid(steps, steps, indexing="ij")
    kernels = graph.constant(np.stack([x, y, np.ones_like(x)])[:, None])
    sums = graph.node("Conv", heat, kernels, pads=[radius] * 4)  # (B, 3, height, width)
    sums = graph.node("Flatten", graph.node("Transpose", sums, perm=[0, 2, 3, 1]), axis=3)  # (B·H·W, 3)
    batch = graph.slice(graph.node("Shape", heat), [0], graph.constant([0]), graph.constant([1]))
    shape = graph.node("Concat", batch, graph.constant([-1, 3]), axis=0)
    rows = graph.node("GatherND", graph.node("Reshape", sums, shape), _unsqueezed(graph, index), batch_dims=1)
    moments = graph.slice(rows, [2], graph.constant([0]), graph.constant([2]))
    mass = graph.slice(rows, [2], graph.constant([2]), graph.constant([3]))
    return str(graph.node("Div", moments, graph.node("Max", mass, graph.number(1e-30))))


def _unsqueezed(graph: OnnxGraph, index: str) -> str:
    return str(graph.node("Unsqueeze", index, graph.constant([2])))


def _sampling_grid(graph: OnnxGraph, keypoints: str, padded_size: str) -> str:
    """Keypoints (B, N, 2) as a grid (B, 1, N, 2) in which -1 and 1 are the outer edges of the padded image."""
    width_height = graph.node("Gather", padded_size, graph.constant([1, 0]))
    scaled = graph.node("Add", graph.node("Mul", keypoints, graph.number(2)), graph.number(1))
    scaled = graph.node("Div", scaled, graph.node("Cast", width_height, to=1))
    return str(graph.node("Unsqueeze", graph.node("Sub", scaled, graph.number(1)), graph.constant([1])))


def _sample(graph: OnnxGraph, cells: str, grid: str) -> str:
    """Bilinear values (B, N, C) of cells (B, C, Hc, Wc)."""
    values = graph.node("GridSample", cells, grid, mode="bilinear", padding_mode="border", align_corners=0)
    return str(graph.node("Transpose", graph.node("Squeeze", values, graph.constant([2])), perm=[0, 2, 1]))
