"""`improvo export onnx WEIGHTS`: one ONNX file that goes from image to keypoints, descriptors and stability."""

from __future__ import annotations

import argparse
from pathlib import Path

from improvo.errors import OutputError
from improvo.frontend.settings import NetworkSettings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Weights, output, and the settings of decoding, which are fixed in the file."""
    defaults = NetworkSettings()
    parser.add_argument("weights", metavar="WEIGHTS", help="a bundled name or a weights file")
    parser.add_argument("-o", "--output", type=Path, required=True, help="ONNX file to write")
    parser.add_argument("--max-keypoints", type=int, default=defaults.max_keypoints, help="rows of the outputs")
    parser.add_argument("--threshold", type=float, default=defaults.threshold, help="least probability of a keypoint")
    parser.add_argument("--nms-radius", type=int, default=defaults.nms_radius, help="of non-maximum suppression, px")
    parser.add_argument("--border", type=int, default=defaults.border, help="no keypoints this close to the edge, px")
    parser.add_argument("--subpixel-radius", type=int, default=defaults.subpixel_radius, help="refinement, px; 0: none")


def run(arguments: argparse.Namespace) -> None:
    """Write the file."""
    from improvo.export.onnx import export_onnx
    from improvo.frontend.weights import find_weights, load_weights

    settings = NetworkSettings(
        max_keypoints=arguments.max_keypoints,
        threshold=arguments.threshold,
        nms_radius=arguments.nms_radius,
        border=arguments.border,
        subpixel_radius=arguments.subpixel_radius,
        corner_radius=0,  # works on the image beside the network; not part of the file
    )
    if not arguments.output.parent.is_dir():
        raise OutputError(f"{arguments.output}: no folder {arguments.output.parent}; make it first")
    export_onnx(load_weights(find_weights(arguments.weights)), arguments.output, settings)
    print(f"{arguments.output}: image (batch, 1, height, width) in [0, 1] -> {settings.max_keypoints} keypoints")
    print("without the move to the image's corners (`improvo.frontend.corners`), which `improvo run` makes afterwards")
