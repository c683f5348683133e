"""`improvo train`: the stages that teach the network."""

from __future__ import annotations

import argparse
import importlib
from types import ModuleType

# stage -> (module under improvo.cli, help line)
STAGES = {
    "shapes": ("train_shapes", "a detector from drawn shapes alone (MagicPoint)"),
    "homographies": ("train_homographies", "detector and descriptor from any pictures, by homographic adaptation"),
    "odometry": ("train_odometry", "all three heads from labelled video: VO adaptation"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add one sub-command per stage; their modules are light until they run."""
    stages = parser.add_subparsers(dest="stage", metavar="STAGE", required=True)
    for name, (module_name, help_line) in STAGES.items():
        module: ModuleType = importlib.import_module(f"improvo.cli.{module_name}")
        child = stages.add_parser(
            name, help=help_line, description=module.__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter
        )
        module.add_arguments(child)
        child.set_defaults(stage_module=module)


def run(arguments: argparse.Namespace) -> int | None:
    """Run the chosen stage."""
    status: int | None = arguments.stage_module.run(arguments)
    return status
