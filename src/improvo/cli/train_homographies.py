"""Train detector and descriptor from any pictures: homographic adaptation, then pairs of views.

A source is an image folder or any SEQUENCE. Without --detector the pictures are labelled by classical corners that are
found again in many random views; with it by that network, which is also how a second round is made. Leaves
weights.safetensors, weights.json (model card), labels.npz, metrics.jsonl and checkpoint.pt in OUT; run again to
continue.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from improvo.cli.options import settings_from
from improvo.cli.train_options import OPTIMISER_FLAGS, add_training_arguments, need_torch, starting_weights, summary
from improvo.errors import InputError
from improvo.files import check_output_folder
from improvo.training.settings import HomographiesSettings

if TYPE_CHECKING:
    from improvo.frontend.weights import DataSource


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `improvo train homographies`."""
    parser.add_argument(
        "sources", nargs="+", metavar="SOURCE[=WEIGHT]", help="image folder or sequence; a higher weight is seen more"
    )
    parser.add_argument(
        "--detector", metavar="WEIGHTS", help="label the pictures with this detector: a file, or a bundled name"
    )
    parser.add_argument(
        "--data-card", type=Path, metavar="FILE", help="JSON list of name, licence, attribution for the model card"
    )
    parser.add_argument(
        "--descriptor-loss", default=argparse.SUPPRESS, help="info_nce, or hinge as SuperPoint has it (info_nce)"
    )
    add_training_arguments(parser, HomographiesSettings().optimiser)


def run(arguments: argparse.Namespace) -> None:
    """Train and print where the weights are."""
    flags = {**OPTIMISER_FLAGS, "descriptor_loss": "descriptor_loss"}
    settings = settings_from(HomographiesSettings, arguments, flags)
    check_output_folder(arguments.output, "train homographies")
    data = read_data_card(arguments.data_card) if arguments.data_card else ()
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
    print(summary(arguments.output, metrics))


def read_data_card(path: Path) -> tuple[DataSource, ...]:
    """What the model card says about the pictures.

    Raises:
        InputError: not a JSON list of name, licence and attribution.
    """
    from improvo.frontend.weights import DataSource

    try:
        return tuple(DataSource(**entry) for entry in json.loads(path.read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise InputError(f"{path}: must be a JSON list of objects with name, licence, attribution ({error})") from None
