"""Self-improvement: label video with a network, train it with the labels, keep it if it got better on other video.

Leaves OUT/weights.safetensors, the best of all rounds and of the start, and OUT/report.html. Part of the video is held
back and never trained on; run again to continue a run that was stopped, or with a higher --rounds.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from improvo.cli.options import (
    FRONTEND_FLAGS,
    add_config_arguments,
    add_sequence_arguments,
    settings_from,
)
from improvo.cli.train_homographies import read_data_card
from improvo.cli.train_options import need_torch
from improvo.errors import ConfigError
from improvo.files import check_output_folder
from improvo.improvement.settings import ImproveSettings

_FLAGS = {
    **FRONTEND_FLAGS,
    "steps": "training.optimiser.steps",
    "batch_size": "training.optimiser.batch_size",
    "device": "training.optimiser.device",
    "threads": "training.optimiser.threads",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo improve`."""
    defaults, absent = ImproveSettings(), argparse.SUPPRESS
    optimiser = defaults.training.optimiser
    parser.add_argument(
        "sequences", type=Path, nargs="+", metavar="SEQUENCE", help="videos, image folders or data sets"
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="OUT", help="folder; an unfinished one is continued"
    )
    parser.add_argument("--rounds", type=int, default=1, metavar="N", help="of labelling, training and judging")
    parser.add_argument(
        "--evaluate",
        type=Path,
        nargs="+",
        default=[],
        metavar="SEQUENCE",
        help="held back to judge by (default: one sequence in five, or the last fifth of a single one)",
    )
    parser.add_argument("--workers", type=int, metavar="N", help="sequences labelled at a time (default: 1)")
    parser.add_argument("--ray", metavar="ADDRESS", help="a Ray cluster that labels them, as in `improvo label`")
    parser.add_argument(
        "--data-card", type=Path, metavar="FILE", help="JSON list of name, licence, attribution for the model card"
    )
    parser.add_argument(
        "--frontend",
        default=absent,
        metavar="NAME",
        help=f"network to begin with: a bundled one, or a .safetensors file (default: {defaults.frontend.name})",
    )
    parser.add_argument(
        "--max-keypoints",
        type=int,
        default=absent,
        metavar="N",
        help=f"per frame (default: {defaults.frontend.max_keypoints})",
    )
    parser.add_argument("--seed", type=int, default=absent, help="of all random choices (default: 0)")
    group = parser.add_argument_group("training")
    group.add_argument(
        "--steps",
        type=int,
        default=absent,
        help=f"of each round, the last third at a falling rate (default: {optimiser.steps})",
    )
    group.add_argument("--batch-size", type=int, default=absent, metavar="N", help=f"(default: {optimiser.batch_size})")
    group.add_argument("--device", default=absent, help="cpu, cuda or auto (default: auto)")
    group.add_argument("--threads", type=int, default=absent, help="of torch on the CPU (default: its own choice)")
    add_sequence_arguments(parser)
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Improve; 0 also where no round was better than the start, which is said."""
    if arguments.rounds < 1:
        raise ConfigError(f"--rounds {arguments.rounds}: must be at least 1")
    extra = [f"training.optimiser.decay_steps={arguments.steps // 3}"] if hasattr(arguments, "steps") else []
    if hasattr(arguments, "seed"):
        extra.append(f"training.optimiser.seed={arguments.seed}")
    settings = settings_from(ImproveSettings, arguments, _FLAGS, extra)
    check_output_folder(arguments.output, "improve")
    data = read_data_card(arguments.data_card) if arguments.data_card else ()
    need_torch()

    from improvo.improvement.improve import improve
    from improvo.improvement.telling import Telling, gain_words
    from improvo.odometry.compile import compile_odometry

    compile_odometry(lambda words: print(words, file=sys.stderr))
    result = improve(
        arguments.sequences,
        arguments.output,
        settings,
        arguments.rounds,
        arguments.evaluate,
        arguments.workers,
        arguments.ray,
        data,
        Telling(lambda text: print(text, flush=True), progress=True),
    )
    if result.best:
        gain = gain_words(result.judgements[result.best], result.judgements[0])
        print(f"kept: {result.candidates[result.best].name}, {gain} matches that survive")
    else:
        print("no round was better than the start; its weights are kept")
    print(f"weights in {result.weights}")
    print(f"report in {arguments.output / 'report.html'}")
    return 0
