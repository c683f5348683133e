"""`improvo demo`: the main job on the bundled recording, command by command, so that a newcomer sees what to type.

Odometry with a network, its pictures, then `improvo improve` on the same recording, and odometry with what that has
learned. A few minutes; run it again to continue one that was stopped.
"""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from improvo.errors import ImprovoError

_STEPS = 400


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo demo`."""
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("output/demo"), metavar="OUT", help="folder for all of it"
    )
    parser.add_argument(
        "--frontend", default="superpoint-small", metavar="NAME", help="network to begin with: a bundled one or a file"
    )
    parser.add_argument("--steps", type=int, default=_STEPS, help="of training")


def run(arguments: argparse.Namespace) -> int:
    """Run, compare with the truth, draw, improve, and run again; prints each command before it runs."""
    from improvo.cli.train_options import need_torch
    from improvo.files import make_output_folder
    from improvo.simulation import bundled_sequence

    need_torch()
    make_output_folder(arguments.output, "demo")
    recording = bundled_sequence()
    before, improved, after = (arguments.output / name for name in ("run", "improve", "run-improved"))
    truth = recording / "groundtruth.txt"
    print(f"A simulated room of 140 frames, with its true poses: {recording}")
    _do("run", recording, "-o", before, "--frontend", arguments.frontend)
    _do("evaluate", "trajectory", before / "trajectory.txt", truth)
    _do("show", "map", before)
    _do("show", "tracks", before)
    _do("show", "labels", before)
    _do("report", before)
    print("\nNow the frontend learns from the labels of this room, and is judged on the part that it never saw.")
    held_back = ("--set", "held_back.share=0.4")  # of so short a recording, for pairs 30 frames apart
    _do("improve", recording, "-o", improved, "--frontend", arguments.frontend, "--steps", arguments.steps, *held_back)
    _do("run", recording, "-o", after, "--frontend", improved / "weights.safetensors")
    _do("evaluate", "trajectory", after / "trajectory.txt", truth)
    print(f"\nDone. Look at {improved / 'report.html'}, {before / 'report.html'} and {before / 'pictures'}.")
    return 0


def _do(*words: object) -> None:
    """One command, as if typed.

    Raises:
        ImprovoError: it failed; its own message is printed already.
    """
    from improvo.cli.main import main

    texts = [str(word) for word in words]
    print(f"\n$ improvo {shlex.join(texts)}", flush=True)
    status = main(texts)
    if status:
        raise ImprovoError(f"the demo stopped: `improvo {texts[0]}` ended with status {status}")
