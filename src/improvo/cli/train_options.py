"""What the commands of the training stages share: options, the model card's data, and what they print at the end."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from improvo.cli.flags import add_setting
from improvo.cli.options import add_config_arguments, folder_path
from improvo.cli.output import figures, next_step, say
from improvo.errors import InputError
from improvo.untrusted.paths import check_is_file
from improvo.untrusted.text import load_json, reason

if TYPE_CHECKING:
    from improvo.frontend.weights_files import DataSource
    from improvo.training.data.pictures import Pictures


def add_training_arguments(parser: argparse.ArgumentParser, defaults: Any, parent: str | None = None) -> None:
    """Where to, from which weights, and the settings that change most often.

    Args:
        defaults: settings of the stage.
        parent: the weights that the stage starts from by default; their architecture is kept. None starts anew.
    """
    parser.add_argument(
        "-o", "--output", type=folder_path, required=True, metavar="OUT", help="folder; an unfinished one is continued"
    )
    parser.add_argument(
        "--from",
        dest="parent",
        default=parent,
        metavar="WEIGHTS",
        help="weights to start from: a file, or a bundled name",
    )
    if parent is None:
        add_setting(parser, defaults, "--architecture", "architecture", help="superpoint or superpoint-small")
    add_optimiser_arguments(parser, defaults, "optimiser")
    add_setting(parser, defaults, "--seed", "optimiser.seed", help="of all random choices")
    add_setting(parser, defaults, "--workers", "optimiser.workers")
    add_config_arguments(parser)


def add_optimiser_arguments(parser: argparse._ActionsContainer, defaults: Any, section: str) -> None:
    """Steps, batch size and device."""
    add_setting(parser, defaults, "--steps", f"{section}.steps", help="of training")
    add_setting(parser, defaults, "--batch-size", f"{section}.batch_size")
    add_setting(parser, defaults, "--device", f"{section}.device", help="to train on: cpu, cuda or auto")
    add_setting(parser, defaults, "--threads", f"{section}.threads", metavar="N")


def add_data_card(parser: argparse.ArgumentParser) -> None:
    """`--data-card`, read back by `read_data_card`."""
    parser.add_argument(
        "--data-card", type=Path, metavar="FILE", help="JSON list of name, licence, attribution for the model card"
    )


def read_data_card(path: Path | None) -> tuple[DataSource, ...]:
    """What the model card says about the pictures.

    Raises:
        InputError: not a JSON list of name, licence and attribution.
    """
    if path is None:
        return ()
    from improvo.frontend.weights_files import DataSource

    try:
        sources = tuple(DataSource(**entry) for entry in load_json(check_is_file(path).read_text(encoding="utf-8")))
        if not all(isinstance(text, str) for one in sources for text in (one.name, one.licence, one.attribution)):
            raise ValueError("something else than words")
    except (OSError, ValueError, TypeError) as error:
        words = "a JSON list of objects with name, licence, attribution"
        raise InputError(f"{path}: must be {words} ({reason(error)})") from None
    return sources


def starting_weights(parent: str | None) -> Path | None:
    """The file that `--from` names.

    Raises:
        InputError: no such weights.
    """
    if parent is None:
        return None
    from improvo.frontend.weights_files import find_weights

    return find_weights(parent)


def say_skipped(pictures: Pictures) -> None:
    """Name the pictures that could not be read."""
    for name in pictures.skipped:
        say(f"skipped {name}: cannot be read")
    if pictures.skipped:
        say(f"{len(pictures.skipped)} pictures skipped, {len(pictures)} read")


def print_metrics(output: Path, metrics: dict[str, Any], then: str) -> None:
    """What a finished stage says.

    Args:
        output: its folder.
        metrics: the last row.
        then: what to do next.
    """
    weights = output / "weights.safetensors"
    losses = ", ".join(f"{name} {metrics[name]:.3f}" for name in ("loss", "detector", "descriptor") if name in metrics)
    waited = (
        f"; {100 * metrics['loading_share']:.0f} % of the time waiting for data" if "loading_share" in metrics else ""
    )
    figures({"weights": str(weights), **metrics}, "")
    say(f"{weights}: step {metrics['step']}{', ' if losses else ''}{losses}{waited}")
    next_step(then)
