"""What makes an ONNX file one that OpenCV 5 loads as a `Feature2D`: `cv2.ALIKED.create(FILE, parameters)`.

OpenCV gives it a colour image, RGB in [0, 1], resized to the `inputSize` of the parameters. It wants exactly three
outputs: `keypoints` (N, 2) in [-1, 1] from one edge of the image to the other, which become (x + 1) / 2 · width;
`descriptors` (N, D); `scores` (N). Keypoints are those of our convention where `inputSize` is the image's own size.
`cv2.DISK` would load a similar file, with whole pixels only.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from improvo.frontend.onnx_graph import OnnxGraph

SHAPES: dict[str, tuple[int | str, ...]] = {  # in the order in which OpenCV asks for them
    "keypoints": ("count", 2),
    "descriptors": ("count", "width"),
    "scores": ("count",),
}
_GREY_OF_RGB = np.array([0.299, 0.587, 0.114], np.float32)  # as cv2.cvtColor


def grey(graph: OnnxGraph) -> str:
    """The grey image (1, 1, height, width) of the input `image` (1, 3, height, width)."""
    return str(graph.node("Conv", "image", graph.constant(_GREY_OF_RGB.reshape(1, 3, 1, 1))))


def outputs(graph: OnnxGraph, found: Mapping[str, str]) -> dict[str, str]:
    """The three outputs from ours, of one image, without the rows past the last keypoint."""
    first = graph.constant([0])
    valid = graph.node("NonZero", graph.node("Squeeze", found["valid"], first))
    rows = graph.node("Squeeze", valid, first)

    def of_one_image(name: str) -> str:
        return str(graph.node("Gather", graph.node("Squeeze", found[name], first), rows, axis=0))

    width_height = graph.node("Gather", graph.node("Shape", "image"), graph.constant([3, 2]))
    doubled = graph.node("Mul", of_one_image("keypoints"), graph.number(2))
    share = graph.node("Div", doubled, graph.node("Cast", width_height, to=1))
    return {
        "keypoints": str(graph.node("Sub", share, graph.number(1))),
        "descriptors": of_one_image("descriptors"),
        "scores": of_one_image("scores"),
    }
