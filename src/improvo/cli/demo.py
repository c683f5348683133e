"""The main job on the bundled recording, command by command, so that a newcomer sees what to type.

Odometry with a network, its pictures, then `improvo improve` on the same recording, and odometry with what that has
learned. A few minutes; run it again to continue one that was stopped. Without the extra `train` the first half is done.
"""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from improvo.cli.output import next_step, say, typed
from improvo.errors import PLOTS_MISSING, ImprovoError, installed, plots_installed

_STEPS = 300
_INTERRUPTED = 130  # exit status


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo demo`."""
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("output/demo"), metavar="OUT", help="folder for all of it"
    )
    parser.add_argument(
        "--frontend", default="superpoint-small", metavar="NAME", help="network to begin with: a bundled one or a file"
    )
    parser.add_argument("--steps", type=int, default=_STEPS, help="of training")


class _InterruptedError(Exception):
    """One of the commands was interrupted, and has said so."""


def run(arguments: argparse.Namespace) -> int:
    """Run, compare with the truth, draw, improve, and run again; prints each command before it runs."""
    try:
        return _run(arguments)
    except _InterruptedError:
        return _INTERRUPTED


def _run(arguments: argparse.Namespace) -> int:
    from improvo.files import make_output_folder
    from improvo.simulation import bundled_sequence

    def do(*words: object) -> None:
        _do([*map(str, words), *(["--quiet"] if arguments.quiet else [])])

    make_output_folder(arguments.output, "demo")
    recording = "demo"
    before, improved, after = (arguments.output / name for name in ("run", "improve", "run-improved"))
    say(f"A simulated room of 140 frames, with its true poses: {bundled_sequence()}")
    do("run", recording, "-o", before, "--frontend", arguments.frontend)
    do("evaluate", "trajectory", before, recording)
    if plots_installed():
        do("show", "map", before)
    else:
        say(f"\nA picture of the map needs an extra: {PLOTS_MISSING}; the map is also in the report below.")
    do("show", "tracks", before)
    do("show", "labels", before)
    do("report", before)
    if not installed("torch"):
        say("\nThe rest, where the frontend learns from this room, needs an extra: pip install 'improvo[train]'")
        next_step(
            f"open {before / 'report.html'}, or install the extra and run `improvo demo -o {typed(arguments.output)}` "
            "again"
        )
        return 0
    say("\nNow the frontend learns from this room, and is validated on what it never saw; beside it a control.")
    # one round is enough to see; what is held back is larger than usual, for pairs 30 frames apart
    options = ["--rounds", "1", "--control", "--set", "split.share=0.4"]
    do("improve", recording, "-o", improved, "--frontend", arguments.frontend, "--steps", arguments.steps, *options)
    do("run", recording, "-o", after, "--frontend", improved / "weights.safetensors")
    do("evaluate", "trajectory", after, recording)
    next_step(f"open {improved / 'report.html'}, {before / 'report.html'} and the pictures in {before / 'pictures'}")
    return 0


def _do(words: list[str]) -> None:
    """One command, as if typed.

    Raises:
        ImprovoError: it failed; its own message is printed already.
        _InterruptedError: it was interrupted.
    """
    from improvo.cli.main import main

    say(f"\n$ improvo {shlex.join(words)}")
    status = main(words)
    if status == _INTERRUPTED:
        raise _InterruptedError
    if status:
        raise ImprovoError(f"the demo stopped: `improvo {words[0]}` ended with status {status}")
