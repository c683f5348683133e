"""`improvo evaluate`: how good a frontend, a trajectory or a set of labels is."""

from __future__ import annotations

import argparse
import importlib
from types import ModuleType

# protocol -> (module under improvo.cli, help line)
PROTOCOLS = {
    "pose": ("evaluate_pose", "3D-to-2D pose estimation, the paper's Table 1, for any frontends"),
    "trajectory": ("evaluate_trajectory", "a trajectory file against the truth: sub-trajectory errors, ATE"),
    "vo": ("evaluate_vo", "visual odometry with and without stability weights, the paper's Table 2"),
    "homography": ("evaluate_homography", "repeatability and homography accuracy on image pairs"),
    "stability": ("evaluate_stability", "instability of labels and heads against its true cause, simulated"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add one sub-command per protocol; their modules are light until they run."""
    protocols = parser.add_subparsers(dest="protocol", metavar="PROTOCOL", required=True)
    for name, (module_name, help_line) in PROTOCOLS.items():
        module: ModuleType = importlib.import_module(f"improvo.cli.{module_name}")
        child = protocols.add_parser(
            name, help=help_line, description=module.__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter
        )
        module.add_arguments(child)
        child.set_defaults(protocol_module=module)


def run(arguments: argparse.Namespace) -> int | None:
    """Run the chosen protocol."""
    status: int | None = arguments.protocol_module.run(arguments)
    return status
