"""`sivo demo`: the main job on the bundled recording, command by command, so that a newcomer sees what to type."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from sivo.errors import SivoError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `sivo demo`."""
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("output/demo"), metavar="OUT", help="folder for all of it"
    )
    parser.add_argument("--frontend", default="sift", metavar="NAME", help="as in `sivo run`")


def run(arguments: argparse.Namespace) -> int:
    """Run, compare with the truth, draw; prints each command before it runs."""
    from sivo.files import make_output_folder
    from sivo.simulation import bundled_sequence

    make_output_folder(arguments.output, "demo")
    recording = bundled_sequence()
    result = arguments.output / "run"
    print(f"A simulated room of 140 frames, with its true poses: {recording}")
    _do("run", recording, "-o", result, "--frontend", arguments.frontend)
    _do("evaluate", "trajectory", result / "trajectory.txt", recording / "groundtruth.txt")
    _do("show", "map", result)
    _do("show", "tracks", result)
    _do("show", "labels", result)
    _do("report", result)
    print(f"\nDone. Look at {result / 'report.html'} and the pictures in {result / 'pictures'}.")
    return 0


def _do(*words: object) -> None:
    """One command, as if typed.

    Raises:
        SivoError: it failed; its own message is printed already.
    """
    from sivo.cli.main import main

    texts = [str(word) for word in words]
    print(f"\n$ sivo {shlex.join(texts)}", flush=True)
    status = main(texts)
    if status:
        raise SivoError(f"the demo stopped: `sivo {texts[0]}` ended with status {status}")
