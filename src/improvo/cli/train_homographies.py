"""Train detector and descriptor from any pictures: homographic adaptation, then pairs of views.

A source is an image folder or any SEQUENCE. Without --detector the pictures are labelled by classical corners that are
found again in many random views; with it by that network, which is also how a second round is made. Leaves
weights.safetensors, weights.json (model card), labels.npz, metrics.jsonl and checkpoint.pt in OUT; run again to
continue.
"""

from __future__ import annotations

import argparse

from improvo.cli.flags import add_setting
from improvo.cli.options import settings_from
from improvo.cli.train_options import (
    add_data_card,
    add_training_arguments,
    print_metrics,
    read_data_card,
    starting_weights,
)
from improvo.files import check_output_folder
from improvo.training.settings import HomographiesSettings
from improvo.verbs import need_torch


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `improvo train homographies`."""
    defaults = HomographiesSettings()
    parser.add_argument(
        "sources", nargs="+", metavar="SOURCE[=WEIGHT]", help="image folder or sequence; a higher weight is seen more"
    )
    parser.add_argument(
        "--detector", metavar="WEIGHTS", help="label the pictures with this detector: a file, or a bundled name"
    )
    add_data_card(parser)
    add_setting(
        parser, defaults, "--descriptor-loss", "descriptor_loss", help="info_nce, or hinge as SuperPoint has it"
    )
    add_training_arguments(parser, defaults)


def run(arguments: argparse.Namespace) -> None:
    """Train and print where the weights are."""
    settings = settings_from(HomographiesSettings, arguments)
    check_output_folder(arguments.output, "train homographies")
    data = read_data_card(arguments.data_card)
    need_torch()
    from improvo.training.stages import train_homographies

    metrics = train_homographies(
        arguments.sources,
        settings,
        arguments.output,
        starting_weights(arguments.parent),
        starting_weights(arguments.detector),
        data,
    )
    weights = arguments.output / "weights.safetensors"
    print_metrics(arguments.output, metrics, f"`improvo run SEQUENCE --frontend {weights} -o out` uses them")
