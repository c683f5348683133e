"""Options that the training stages share."""

from __future__ import annotations

import argparse
import importlib.util
from pathlib import Path
from typing import Any

from improvo.cli.options import add_config_arguments
from improvo.errors import MissingExtraError
from improvo.training.settings import OptimiserSettings

OPTIMISER_FLAGS = {
    "architecture": "architecture",
    "steps": "optimiser.steps",
    "batch_size": "optimiser.batch_size",
    "seed": "optimiser.seed",
    "device": "optimiser.device",
    "threads": "optimiser.threads",
    "workers": "optimiser.workers",
}


def add_training_arguments(
    parser: argparse.ArgumentParser, defaults: OptimiserSettings, parent: str | None = None
) -> None:
    """Where to, from which weights, and the settings that change most often.

    Args:
        defaults: of the stage.
        parent: the weights that the stage starts from by default; their architecture is kept. None starts anew.
    """
    absent = argparse.SUPPRESS
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="OUT", help="folder; an unfinished one is continued"
    )
    parser.add_argument(
        "--from",
        dest="parent",
        default=parent,
        metavar="WEIGHTS",
        help="weights to start from: a file, or a bundled name",
    )
    if parent is None:
        parser.add_argument(
            "--architecture", default=absent, help="superpoint or superpoint-small (default: superpoint)"
        )
    parser.add_argument("--steps", type=int, default=absent, help=f"of training (default: {defaults.steps})")
    parser.add_argument("--batch-size", type=int, default=absent, metavar="N", help=f"(default: {defaults.batch_size})")
    parser.add_argument("--seed", type=int, default=absent, help=f"(default: {defaults.seed})")
    parser.add_argument("--device", default=absent, help="cpu, cuda or auto (default: auto)")
    parser.add_argument("--threads", type=int, default=absent, help="of torch on the CPU (default: its own choice)")
    parser.add_argument("--workers", type=int, default=absent, help=f"data processes (default: {defaults.workers})")
    add_config_arguments(parser)


def starting_weights(parent: str | None) -> Path | None:
    """The file that `--from` names.

    Raises:
        InputError: no such weights.
    """
    if parent is None:
        return None
    from improvo.frontend.weights import find_weights

    return find_weights(parent)


def need_torch() -> None:
    """Raise MissingExtraError where torch is not installed."""
    if importlib.util.find_spec("torch") is None:
        raise MissingExtraError("training", "train")


def summary(output: Path, metrics: dict[str, Any]) -> str:
    """What a finished stage prints."""
    losses = ", ".join(f"{name} {metrics[name]:.3f}" for name in ("loss", "detector", "descriptor") if name in metrics)
    waited = f"{100 * metrics['loading_share']:.0f} % of the time waiting for data"
    return f"{output / 'weights.safetensors'}: step {metrics['step']}, {losses}; {waited}"
