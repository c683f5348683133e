"""Adapt a network to video by visual odometry: train on the labels that `improvo label` made (the paper's step).

Pairs of frames up to 60 apart, each under its own random homography: stable points teach detector and descriptor,
stable against unstable ones the stability head, and what is unknown is ignored. Leaves weights.safetensors,
weights.json (model card), metrics.jsonl and checkpoint.pt in OUT; run again to continue.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from improvo.cli.options import settings_from
from improvo.cli.train_homographies import read_data_card
from improvo.cli.train_options import OPTIMISER_FLAGS, add_training_arguments, need_torch, summary
from improvo.files import check_output_folder
from improvo.training.settings import OdometryTrainingSettings

PAPER = [
    "landmarks.shared=false",
    "landmarks.unseen=false",
    "landmarks.reprojected=false",
    "landmarks.unstable_median_error=0",
    "landmarks.unstable_largest_step=1",
]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `improvo train odometry`."""
    defaults = OdometryTrainingSettings()
    parser.add_argument(
        "labels", nargs="+", type=Path, metavar="LABELS", help="label stores, as `improvo label` makes them"
    )
    parser.add_argument(
        "--pictures",
        nargs="+",
        default=[],
        metavar="SOURCE[=WEIGHT]",
        help="image folders or sequences rehearsed beside the labels, as homography pairs, so that the network stays "
        "general",
    )
    parser.add_argument(
        "--data-card", type=Path, metavar="FILE", help="JSON list of name, licence, attribution for the model card"
    )
    parser.add_argument(
        "--paper",
        action="store_true",
        help="teach what the paper does: each track by itself, only where it was seen, and every unstable label",
    )
    add_training_arguments(parser, defaults.optimiser, parent="superpoint")


def run(arguments: argparse.Namespace) -> None:
    """Train and print where the weights are."""
    flags = {name: setting for name, setting in OPTIMISER_FLAGS.items() if name != "architecture"}
    paper = PAPER if arguments.paper else []
    settings = settings_from(OdometryTrainingSettings, arguments, flags, paper)
    check_output_folder(arguments.output, "train odometry")
    data = read_data_card(arguments.data_card) if arguments.data_card else ()
    need_torch()
    from improvo.frontend.weights import find_weights
    from improvo.training.stages import train_odometry

    start = find_weights(arguments.parent)
    metrics = train_odometry(arguments.labels, settings, arguments.output, start, data, pictures=arguments.pictures)
    print(summary(arguments.output, metrics))
