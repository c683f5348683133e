"""`improvo export onnx WEIGHTS`: one ONNX file that goes from image to keypoints, descriptors and stability."""

from __future__ import annotations

import argparse
from pathlib import Path

from improvo.cli.flags import add_setting
from improvo.cli.output import next_step, say
from improvo.errors import OutputError
from improvo.frontend.settings import NetworkSettings

_SETTINGS = ("max_keypoints", "threshold", "nms_radius", "border", "subpixel_radius")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Weights, output, and the settings of decoding, which are fixed in the file."""
    defaults = NetworkSettings()
    parser.add_argument("weights", metavar="WEIGHTS", help="a bundled name or a weights file")
    parser.add_argument("-o", "--output", type=Path, required=True, help="ONNX file to write")
    for name in _SETTINGS:
        add_setting(parser, defaults, f"--{name.replace('_', '-')}", name)


def run(arguments: argparse.Namespace) -> None:
    """Write the file."""
    from improvo.export.onnx import export_onnx
    from improvo.frontend.weights import find_weights, load_weights

    given = {name: getattr(arguments, name) for name in _SETTINGS if hasattr(arguments, name)}
    # the move to corners works on the image beside the network, and is no part of the file
    settings = NetworkSettings(**given, corner_radius=0)
    if not arguments.output.parent.is_dir():
        raise OutputError(f"{arguments.output}: no folder {arguments.output.parent}; make it first")
    export_onnx(load_weights(find_weights(arguments.weights)), arguments.output, settings)
    say(f"{arguments.output}: image (batch, 1, height, width) in [0, 1] -> {settings.max_keypoints} keypoints")
    say("without the move to the image's corners (`improvo.frontend.corners`), which `improvo run` makes afterwards")
    next_step("load it with ONNX Runtime or any other runtime")
