"""Self-improvement: train a network on video by its own odometry, keep it if it got better on video it never saw.

Leaves OUT/weights.safetensors, the best of all rounds and of the start, and OUT/report.html. Part of the video is held
out and never trained on; run again to continue a run that was stopped, or with a higher --rounds. By itself it makes
two rounds, or one where the first is not better, or where two would take much more than half an hour.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from improvo.cli import output
from improvo.cli.auto_camera import with_found_camera
from improvo.cli.begun_with import add_words, flag_words
from improvo.cli.flags import add_setting
from improvo.cli.label import add_job_arguments
from improvo.cli.options import (
    add_config_arguments,
    add_sequence_arguments,
    check_recordings,
    folder_path,
    recording_path,
    settings_from,
)
from improvo.cli.output import figures, next_step, notice, say, typed
from improvo.cli.plan import say_improve_plan
from improvo.cli.train_options import add_data_card, read_data_card
from improvo.continuation import value_of
from improvo.errors import ConfigError
from improvo.files import check_output_folder
from improvo.frontend.registry import check_frontend
from improvo.improvement.settings import METRIC, RECIPES, ImproveSettings
from improvo.verbs import need_torch

_SECTIONS = ("held", "training")  # settings of the recipes that train step by step
_OF_BOTH = ("steps", "seed", "batch_size", "device", "threads")  # flags for the optimiser of either


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo improve`."""
    defaults = ImproveSettings()
    parser.add_argument(
        "sequences", type=recording_path, nargs="+", metavar="SEQUENCE", help="videos, image folders or data sets"
    )
    parser.add_argument(
        "-o", "--output", type=folder_path, metavar="OUT", help="folder; an unfinished one is continued"
    )
    parser.add_argument(
        "--plan", action="store_true", help="label a short sample only, and say what all of it will cost"
    )
    parser.add_argument(
        "--rounds",
        type=int,
        metavar="N",
        help="of training and validation; where one is not better the next tries again (default: 2, or 1 where that is "
        "not better or two take much more than half an hour)",
    )
    parser.add_argument(
        "--evaluate",
        type=recording_path,
        nargs="+",
        default=[],
        metavar="SEQUENCE",
        help="held out for validation (default: one sequence in five, or of a single one the last fifth, of a short "
        "one 60 frames or a third)",
    )
    parser.add_argument(
        "--after",
        type=Path,
        metavar="FOLDER",
        help="finished OUT of an earlier run: starts from its weights; recordings that it had are replayed and must "
        "not get worse, the others are new",
    )
    add_job_arguments(parser)
    add_data_card(parser)
    add_setting(
        parser,
        defaults,
        "--frontend",
        "frontend.name",
        metavar="NAME",
        help="network to begin with: a bundled one, or a .safetensors file",
    )
    add_setting(parser, defaults, "--max-keypoints", "frontend.max_keypoints")
    add_setting(parser, defaults, "--seed", "odometry.seed", help="of all random choices")
    group = parser.add_argument_group("training, in each round")
    add_setting(group, defaults, "--recipe", "recipe", choices=RECIPES)
    add_setting(group, defaults, "--minutes", "minutes")
    add_setting(group, defaults, "--control", "control")
    for flag, text in (
        ("--steps", "of training (default: 1 for each frame, 300 to 1200 in all; 1000 with the recipe tracks)"),
        ("--batch-size", "pairs of images a step (default: 2; 8 smaller ones with the recipe tracks)"),
    ):
        group.add_argument(flag, type=int, default=argparse.SUPPRESS, metavar="N", help=text)
    add_setting(group, defaults, "--device", "held.optimiser.device", help="to train on: cpu, cuda or auto")
    add_setting(group, defaults, "--threads", "held.optimiser.threads", metavar="N")
    add_sequence_arguments(parser)
    add_config_arguments(parser)
    both = {f"{section}.optimiser.{name}": f"--{name.replace('_', '-')}" for section in _SECTIONS for name in _OF_BOTH}
    add_words(parser, {setting: flag_words(setting, flag) for setting, flag in both.items()})
    add_words(parser, {"steps_per_frame": _steps_words})


def _steps_words(settings: Any) -> str:
    """`--steps` leaves none of the steps to the number of frames."""
    steps = value_of("held.optimiser.steps", settings)
    return "without --steps" if value_of("steps_per_frame", settings) else f"with --steps {steps}"


def _of_both_recipes(arguments: argparse.Namespace) -> list[str]:
    """Settings of the optimiser that a flag gives to either recipe."""
    extra = []
    for name in _OF_BOTH:
        if hasattr(arguments, name):
            extra += [f"{section}.optimiser.{name}={getattr(arguments, name)}" for section in _SECTIONS]
    if hasattr(arguments, "steps"):
        if getattr(arguments, "recipe", "") == METRIC:
            raise ConfigError("--steps: the recipe `metric` makes none; --set metric.pairs=N is how much it looks at")
        extra.append("steps_per_frame=0")
        extra += [f"{section}.optimiser.decay_steps={arguments.steps // 3}" for section in _SECTIONS]
        if arguments.steps < 1:
            raise ConfigError(f"--steps {arguments.steps}: must be at least 1")
        if getattr(arguments, "minutes", 0):
            raise ConfigError("--steps and --minutes: give one of them")
    return extra


def run(arguments: argparse.Namespace) -> int:
    """Improve; 0 also where no round was better than the start, which is said."""
    if arguments.rounds is not None and arguments.rounds < 1:
        raise ConfigError(f"--rounds {arguments.rounds}: must be at least 1")
    settings = settings_from(ImproveSettings, arguments, extra=_of_both_recipes(arguments))
    check_recordings(arguments.sequences, settings.sequence)
    check_frontend(settings.frontend.name)
    if arguments.plan:
        return _plan(arguments, settings)
    if arguments.output is None:
        raise ConfigError("-o OUT: is missing; it is the folder of the results")
    check_output_folder(arguments.output, "improve")
    data = read_data_card(arguments.data_card)
    need_torch()
    recordings = [*arguments.sequences, *arguments.evaluate]
    settings = with_found_camera(settings, recordings, arguments.output, "improve")

    from improvo.depth.compile import compile_depth
    from improvo.improvement.improve import improve
    from improvo.improvement.progress import ImprovementProgress
    from improvo.improvement.validation import gain_words
    from improvo.odometry.run.compile import compile_odometry

    compile_odometry(notice)
    compile_depth(notice)
    result = improve(
        arguments.sequences,
        arguments.output,
        settings,
        arguments.rounds,
        arguments.evaluate,
        arguments.workers,
        arguments.ray,
        data,
        ImprovementProgress(say, shown=not output.as_json()),
        after=arguments.after,
    )
    kept, judge = result.candidates[result.best].name, settings.validation.matches
    figures({"weights": str(result.weights), "best": result.best, "kept": kept}, "")
    if result.best:
        say(f"kept: {kept}; {gain_words(result.validations[result.best], result.validations[0], judge)}")
    else:
        say("no round was better than the start; its weights are kept")
    if result.control:
        control, validation = result.control
        say(f"{control.name}, by homographies alone: {gain_words(validation, result.validations[0], judge)}")
    say(f"weights in {result.weights}")
    say(f"report in {arguments.output / 'report.html'}")
    next_step(f"`improvo run SEQUENCE --frontend {typed(result.weights)} -o out` uses them")
    return 0


def _plan(arguments: argparse.Namespace, settings: ImproveSettings) -> int:
    """Measure a sample; nothing is left but cameras that were looked for, in the user's cache."""
    from improvo.improvement.plan import plan_improvement
    from improvo.odometry.run.compile import compile_odometry
    from improvo.terminal import progress

    settings = with_found_camera(settings, [*arguments.sequences, *arguments.evaluate], None, "improve")
    compile_odometry(notice)
    with progress("sample", "frame") as shown:
        plan = plan_improvement(
            arguments.sequences, settings, arguments.rounds, arguments.evaluate, shown.advance, arguments.after
        )
    say_improve_plan(plan, arguments.rounds is not None)
    next_step("the same without --plan and with -o OUT does it")
    return 0
