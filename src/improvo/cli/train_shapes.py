"""Train a keypoint detector from drawn shapes alone (MagicPoint): no pictures needed.

Leaves weights.safetensors, weights.json (model card), metrics.jsonl and checkpoint.pt in OUT; run again to continue.
"""

from __future__ import annotations

import argparse

from improvo.cli.options import settings_from
from improvo.cli.train_options import OPTIMISER_FLAGS, add_training_arguments, need_torch, starting_weights, summary
from improvo.files import check_output_folder
from improvo.training.settings import ShapesSettings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `improvo train shapes`."""
    add_training_arguments(parser, ShapesSettings().optimiser)


def run(arguments: argparse.Namespace) -> None:
    """Train and print where the weights are."""
    settings = settings_from(ShapesSettings, arguments, OPTIMISER_FLAGS)
    check_output_folder(arguments.output, "train shapes")
    need_torch()
    from improvo.training.stages import train_shapes

    print(summary(arguments.output, train_shapes(settings, arguments.output, starting_weights(arguments.parent))))
