"""`improvo train shapes`, `homographies` and `odometry`: the stages that teach the network."""

from __future__ import annotations

import argparse

from improvo.cli.flags import add_setting
from improvo.cli.options import pictures_source, read_folder_path, settings_from
from improvo.cli.output import typed
from improvo.cli.train_options import (
    add_data_card,
    add_training_arguments,
    print_metrics,
    read_data_card,
    say_skipped,
    starting_weights,
)
from improvo.files import check_output_folder
from improvo.training.settings import HomographiesSettings, OdometryTrainingSettings, ShapesSettings
from improvo.verbs import need_torch


def add_shapes_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `improvo train shapes`."""
    add_training_arguments(parser, ShapesSettings())


def run_shapes(arguments: argparse.Namespace) -> None:
    """Train a detector from drawn shapes alone ("MagicPoint"): the start of everything where there are no weights.

    Leaves weights.safetensors, weights.json (model card), metrics.jsonl and checkpoint.pt in OUT; run again to
    continue.
    """
    settings = settings_from(ShapesSettings, arguments)
    check_output_folder(arguments.output, "train shapes")
    need_torch()
    from improvo.training.superpoint_training import train_shapes

    metrics = train_shapes(settings, arguments.output, starting_weights(arguments.parent))
    weights = arguments.output / "weights.safetensors"
    print_metrics(
        arguments.output, metrics, f"`improvo train homographies PICTURES --detector {typed(weights)} -o network`"
    )


def add_homographies_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `improvo train homographies`."""
    defaults = HomographiesSettings()
    parser.add_argument(
        "sources",
        nargs="+",
        type=pictures_source,
        metavar="SOURCE[=WEIGHT]",
        help="image folder or sequence; a higher weight is seen more",
    )
    parser.add_argument(
        "--detector", metavar="WEIGHTS", help="label the pictures with this detector: a file, or a bundled name"
    )
    add_data_card(parser)
    loss = "info_nce, or hinge as SuperPoint has it"
    add_setting(parser, defaults, "--descriptor-loss", "descriptor_loss", help=loss)
    add_training_arguments(parser, defaults)


def run_homographies(arguments: argparse.Namespace) -> None:
    """Train detector and descriptor from any pictures: homographic adaptation, then pairs of views.

    A source is an image folder or any SEQUENCE. Without --detector the pictures are labelled by classical corners that
    are found again in many random views; with it by that network, which is also how a second round is made. Leaves
    weights.safetensors, weights.json (model card), labels.npz, metrics.jsonl and checkpoint.pt in OUT; run again to
    continue.
    """
    settings = settings_from(HomographiesSettings, arguments)
    check_output_folder(arguments.output, "train homographies")
    data = read_data_card(arguments.data_card)
    need_torch()
    from improvo.training.superpoint_training import train_homographies

    metrics = train_homographies(
        arguments.sources,
        settings,
        arguments.output,
        starting_weights(arguments.parent),
        starting_weights(arguments.detector),
        data,
        on_pictures=say_skipped,
    )
    weights = arguments.output / "weights.safetensors"
    print_metrics(arguments.output, metrics, f"`improvo run SEQUENCE --frontend {typed(weights)} -o out` uses them")


def add_odometry_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `improvo train odometry`."""
    parser.add_argument(
        "labels", nargs="+", type=read_folder_path, metavar="LABELS", help="label stores, as `improvo label` makes them"
    )
    parser.add_argument(
        "--pictures",
        nargs="+",
        type=pictures_source,
        default=[],
        metavar="SOURCE[=WEIGHT]",
        help="image folders or sequences to train on beside the labels, as homography pairs, so that the network stays "
        "general",
    )
    add_data_card(parser)
    add_training_arguments(parser, OdometryTrainingSettings(), parent="superpoint")


def run_odometry(arguments: argparse.Namespace) -> None:
    """Adapt a network to video by visual odometry: train on the labels that `improvo label` made (the paper's step).

    Pairs of frames up to 60 apart, each under its own random homography: stable points teach detector and descriptor,
    stable against unstable ones the stability head, and what is unknown is ignored. Leaves weights.safetensors,
    weights.json (model card), metrics.jsonl and checkpoint.pt in OUT; run again to continue.
    """
    settings = settings_from(OdometryTrainingSettings, arguments)
    check_output_folder(arguments.output, "train odometry")
    data = read_data_card(arguments.data_card)
    need_torch()
    from improvo.frontend.weights_files import find_weights
    from improvo.training.odometry_training import train_odometry

    start = find_weights(arguments.parent)
    metrics = train_odometry(arguments.labels, settings, arguments.output, start, data, pictures=arguments.pictures)
    weights = arguments.output / "weights.safetensors"
    print_metrics(
        arguments.output,
        metrics,
        f"`improvo run SEQUENCE --frontend {typed(weights)} -o out` uses them, `improvo evaluate pose SEQUENCE "
        f"--frontend {typed(weights)} --frontend {typed(arguments.parent)}` compares",
    )
