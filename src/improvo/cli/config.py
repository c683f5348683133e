"""`improvo config [COMMAND]`: all settings as YAML, ready to edit and to give back with --config."""

from __future__ import annotations

import argparse
import importlib

from improvo.cli.options import add_config_arguments

SETTINGS = {  # command -> its settings
    "simulate": "improvo.simulation.settings:SimulationSettings",
    "improve": "improvo.improvement.settings:ImproveSettings",
    "label": "improvo.odometry.run_settings:LabelRunSettings",
    "run": "improvo.depth.run_settings:DenseRunSettings",
    "evaluate-pose": "improvo.evaluation.settings:PoseCommandSettings",
    "evaluate-trajectory": "improvo.evaluation.settings:TrajectoryCommandSettings",
    "evaluate-vo": "improvo.evaluation.settings:VoCommandSettings",
    "truth": "improvo.evaluation.truth.settings:TruthCommandSettings",
    "evaluate-homography": "improvo.evaluation.settings:HomographyCommandSettings",
    "train-shapes": "improvo.training.settings:ShapesSettings",
    "train-homographies": "improvo.training.settings:HomographiesSettings",
    "train-odometry": "improvo.training.settings:OdometryTrainingSettings",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo config`."""
    parser.add_argument("command", nargs="?", default="run", choices=sorted(SETTINGS), help="whose settings")
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Print the settings."""
    from improvo import config

    module, _, name = SETTINGS[arguments.command].partition(":")
    cls = getattr(importlib.import_module(module), name)
    print(config.to_yaml(config.load(cls, arguments.config, arguments.set)), end="")
    return 0
