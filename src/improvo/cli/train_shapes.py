"""Train a detector from drawn shapes alone ("MagicPoint"): the start of everything where there are no weights.

Leaves weights.safetensors, weights.json (model card), metrics.jsonl and checkpoint.pt in OUT; run again to continue.
"""

from __future__ import annotations

import argparse

from improvo.cli.options import settings_from
from improvo.cli.train_options import add_training_arguments, print_metrics, starting_weights
from improvo.files import check_output_folder
from improvo.training.settings import ShapesSettings
from improvo.verbs import need_torch


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `improvo train shapes`."""
    add_training_arguments(parser, ShapesSettings())


def run(arguments: argparse.Namespace) -> None:
    """Train and print where the weights are."""
    settings = settings_from(ShapesSettings, arguments)
    check_output_folder(arguments.output, "train shapes")
    need_torch()
    from improvo.training.stages import train_shapes

    metrics = train_shapes(settings, arguments.output, starting_weights(arguments.parent))
    weights = arguments.output / "weights.safetensors"
    print_metrics(arguments.output, metrics, f"`improvo train homographies PICTURES --detector {weights} -o network`")
