"""Reference poses and the camera of a recording by structure from motion, to measure odometry and frontends against.

The scale comes from the recording's depth images, or from `--scale-from`. A bad result is not written. What the work
has reached so far lies beside FILE, and an interrupted call goes on from there.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from improvo import terminal
from improvo.cli.auto_camera import with_found_camera
from improvo.cli.evaluate_options import available_cores
from improvo.cli.options import (
    add_config_arguments,
    add_sequence_arguments,
    recording_path,
    recording_words,
    settings_from,
)
from improvo.cli.output import figures, next_step, typed
from improvo.evaluation.truth.settings import CALIBRATE, TruthCommandSettings, TruthSettings

_FLAGS = {"calibrate": "truth.calibrate", "max_features": "truth.max_features", "seed": "truth.seed"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `improvo truth`."""
    defaults, absent = TruthSettings(), argparse.SUPPRESS
    parser.add_argument("sequence", type=recording_path, metavar="SEQUENCE")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", required=True, help="poses and camera")
    parser.add_argument("--scale-from", metavar="POSES", help="poses in metres, where the recording has no depth")
    parser.add_argument("--model", type=Path, metavar="DIR", help="a COLMAP model, instead of making one")
    parser.add_argument(
        "--calibrate",
        choices=CALIBRATE,
        default=absent,
        help="how much of the camera is found from the images; `full` needs a camera that turns in several directions "
        f"(default: {defaults.calibrate})",
    )
    parser.add_argument(
        "--max-features",
        type=int,
        default=absent,
        metavar="N",
        help=f"SIFT features per image (default: {defaults.max_features})",
    )
    parser.add_argument("--seed", type=int, default=absent, help=f"of all random choices (default: {defaults.seed})")
    parser.add_argument("--workers", type=int, default=available_cores(), metavar="N", help="threads of COLMAP")
    add_sequence_arguments(parser)
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Write FILE and its quality as JSON beside it; print the quality."""
    from improvo.evaluation.truth.make import make_truth
    from improvo.evaluation.truth.structure_from_motion import load_pycolmap
    from improvo.files import check_output_file
    from improvo.sequences import open_sequence

    settings = settings_from(TruthCommandSettings, arguments, _FLAGS)
    load_pycolmap()  # said before any work
    check_output_file(arguments.output, (".txt",), ".json")
    settings = with_found_camera(settings, [arguments.sequence], None, "truth")
    sequence = open_sequence(arguments.sequence, settings.sequence)
    with terminal.stages("step") as told:
        quality = make_truth(
            sequence,
            arguments.output,
            settings.truth,
            scale_from=arguments.scale_from,
            model=arguments.model,
            threads=arguments.workers,
            progress=told,
        )
    figures(asdict(quality), f"{arguments.output}: {quality.text()}")
    recording = recording_words(arguments.sequence)
    next_step(f"`improvo evaluate trajectory OUT {recording} --truth {typed(arguments.output)}`")
    return 0
