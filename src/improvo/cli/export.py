"""`improvo export TARGET`: what other tools read. Each target is a module with `add_arguments(parser)` and `run`."""

from __future__ import annotations

import argparse
import importlib

# target -> (module under improvo.cli, help line)
TARGETS: dict[str, tuple[str, str]] = {
    "onnx": ("export_onnx", "a network with its decoding, for ONNX Runtime"),
    "colmap": ("export_colmap", "a finished run as COLMAP's sparse model, with images"),
    "nerfstudio": ("export_nerfstudio", "a finished run as Nerfstudio's transforms.json, with images"),
    "trajectory": ("export_trajectory", "the poses of a finished run as TUM, KITTI or EuRoC file"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The targets and their options."""
    targets = parser.add_subparsers(dest="target", metavar="TARGET", required=True)
    for name, (module_name, help_line) in TARGETS.items():
        target = targets.add_parser(
            name, help=help_line, description=help_line, formatter_class=argparse.ArgumentDefaultsHelpFormatter
        )
        module = importlib.import_module(f"improvo.cli.{module_name}")
        module.add_arguments(target)
        target.set_defaults(target_function=module.run)


def run(arguments: argparse.Namespace) -> None:
    """Export to the chosen target."""
    arguments.target_function(arguments)
