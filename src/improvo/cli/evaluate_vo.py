"""Visual odometry with and without stability weights on sequences with true poses (the paper's Table 2).

A frontend without a stability head gets one row. Sequences whose truth has invalid poses are left out and named.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from improvo.cli.auto_camera import with_found_camera
from improvo.cli.evaluate_options import (
    add_frontend_arguments,
    add_run_arguments,
    add_truth_argument,
)
from improvo.cli.evaluate_trajectory import TRAJECTORY_FLAGS, add_trajectory_arguments
from improvo.cli.options import add_config_arguments, add_sequence_arguments, recording_path, settings_from
from improvo.cli.output import figures, next_after_figures
from improvo.evaluation.settings import VoCommandSettings

COMMAND = "evaluate vo"
_DEFAULT = ("superpoint-vo",)
_FLAGS = {
    **TRAJECTORY_FLAGS,
    "max_keypoints": "max_keypoints",
    "mode": "odometry.mode",
    "seed": "odometry.seed",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `improvo evaluate vo`; `--stride` is 10 unless given."""
    defaults = VoCommandSettings()
    parser.add_argument("sequences", nargs="+", type=recording_path, metavar="SEQUENCE", help="with true poses")
    add_truth_argument(parser)
    add_frontend_arguments(parser, defaults.max_keypoints, _DEFAULT, peers=False)
    parser.add_argument(
        "--mode",
        choices=("robust", "paper"),
        default=argparse.SUPPRESS,
        help=f"of the odometry (default: {defaults.odometry.mode})",
    )
    add_trajectory_arguments(parser)
    add_run_arguments(parser)
    add_sequence_arguments(parser, defaults.sequence)
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> int | None:
    """Print Table 2; with -o leave vo.json, vo.md and the trajectories."""
    from improvo import __version__
    from improvo.cli.evaluate_options import loaded_frontends, recorded_sequences
    from improvo.config import to_dict
    from improvo.evaluation.sources import file_name
    from improvo.evaluation.trajectory.tables import vo_tables
    from improvo.evaluation.vo.protocol import evaluate_vo
    from improvo.files import check_output_folder, make_output_folder, write_json, write_text
    from improvo.geometry.trajectory_files import write_trajectory
    from improvo.jobs.pool import Workers

    settings = settings_from(VoCommandSettings, arguments, _FLAGS)
    output: Path | None = arguments.output
    if output is not None:
        check_output_folder(output, COMMAND)
    settings = with_found_camera(settings, arguments.sequences, output, COMMAND)
    frontends, skipped = loaded_frontends(arguments.frontend, settings.max_keypoints, _DEFAULT, peers=False)
    sources = recorded_sequences(arguments, settings.sequence)
    with Workers(arguments.workers, progress=True) as workers:
        outcomes, found = evaluate_vo(sources, frontends, settings.odometry, settings.trajectory, workers)
    results = {
        "protocol": "vo",
        "improvo": __version__,
        "settings": to_dict(settings),
        **found,
        "skipped_frontends": skipped,
    }
    text = vo_tables(results)
    figures(results, text)
    if output is not None:
        make_output_folder(output, COMMAND)
        for outcome in outcomes:
            folder = output / f"{file_name(outcome.frontend)}{outcome.variant}"
            folder.mkdir(exist_ok=True)
            write_trajectory(folder / f"{outcome.sequence}.txt", outcome.trajectory)
        write_json(output / "vo.json", results)
        write_text(output / "vo.md", text)
    next_after_figures(arguments.output)
    return 0
