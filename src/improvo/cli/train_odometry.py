"""Adapt a network to video by visual odometry: train on the labels that `improvo label` made (the paper's step).

Pairs of frames up to 60 apart, each under its own random homography: stable points teach detector and descriptor,
stable against unstable ones the stability head, and what is unknown is ignored. Leaves weights.safetensors,
weights.json (model card), metrics.jsonl and checkpoint.pt in OUT; run again to continue.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from improvo.cli.options import settings_from
from improvo.cli.train_options import add_data_card, add_training_arguments, print_metrics, read_data_card
from improvo.files import check_output_folder
from improvo.training.settings import OdometryTrainingSettings
from improvo.verbs import need_torch


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `improvo train odometry`."""
    parser.add_argument(
        "labels", nargs="+", type=Path, metavar="LABELS", help="label stores, as `improvo label` makes them"
    )
    parser.add_argument(
        "--pictures",
        nargs="+",
        default=[],
        metavar="SOURCE[=WEIGHT]",
        help="image folders or sequences to train on beside the labels, as homography pairs, so that the network stays "
        "general",
    )
    add_data_card(parser)
    add_training_arguments(parser, OdometryTrainingSettings(), parent="superpoint")


def run(arguments: argparse.Namespace) -> None:
    """Train and print where the weights are."""
    settings = settings_from(OdometryTrainingSettings, arguments)
    check_output_folder(arguments.output, "train odometry")
    data = read_data_card(arguments.data_card)
    need_torch()
    from improvo.frontend.weights import find_weights
    from improvo.training.stages import train_odometry

    start = find_weights(arguments.parent)
    metrics = train_odometry(arguments.labels, settings, arguments.output, start, data, pictures=arguments.pictures)
    weights = arguments.output / "weights.safetensors"
    print_metrics(
        arguments.output,
        metrics,
        f"`improvo run SEQUENCE --frontend {weights} -o out` uses them, `improvo evaluate pose SEQUENCE --frontend "
        f"{weights} --frontend {arguments.parent}` compares",
    )
