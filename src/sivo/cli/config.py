"""`sivo config [COMMAND]`: all settings as YAML, ready to edit and to give back with --config."""

from __future__ import annotations

import argparse
import importlib

from sivo.cli.options import add_config_arguments

SETTINGS = {  # command -> its settings
    "simulate": "sivo.simulation.settings:SimulationSettings",
    "improve": "sivo.improvement.settings:ImproveSettings",
    "label": "sivo.odometry.run_settings:LabelRunSettings",
    "run": "sivo.odometry.run_settings:RunSettings",
    "evaluate-pose": "sivo.evaluation.settings:PoseCommandSettings",
    "evaluate-trajectory": "sivo.evaluation.settings:TrajectoryCommandSettings",
    "evaluate-vo": "sivo.evaluation.settings:VoCommandSettings",
    "evaluate-homography": "sivo.evaluation.settings:HomographyCommandSettings",
    "train-shapes": "sivo.training.settings:ShapesSettings",
    "train-homographies": "sivo.training.settings:HomographiesSettings",
    "train-odometry": "sivo.training.settings:OdometryTrainingSettings",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `sivo config`."""
    parser.add_argument("command", nargs="?", default="run", choices=sorted(SETTINGS), help="whose settings")
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Print the settings."""
    from sivo import config

    module, _, name = SETTINGS[arguments.command].partition(":")
    cls = getattr(importlib.import_module(module), name)
    print(config.to_yaml(config.load(cls, arguments.config, arguments.set)), end="")
    return 0
