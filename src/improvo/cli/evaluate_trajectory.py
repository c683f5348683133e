"""A trajectory against the truth (Zhang and Scaramuzza 2018): absolute error, relative errors over sub-trajectories.

ESTIMATE is a TUM, KITTI or EuRoC file, or the output folder of `improvo run`; TRUTH is such a file or folder, or a
sequence that has true poses or gets them by --truth. Segments of an estimate (`# segment N` lines) are aligned each on
its own.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from improvo.cli.options import add_config_arguments, add_sequence_arguments, recording_path, settings_from
from improvo.cli.output import figures, next_after_figures
from improvo.evaluation.settings import ALIGNMENTS, TrajectoryCommandSettings, TrajectorySettings

if TYPE_CHECKING:
    from improvo.types import Trajectory

_FASTEST = 200.0  # metres a second, beyond which no camera moves
COMMAND = "evaluate trajectory"
KITTI_LENGTHS = [100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0]
TRAJECTORY_FLAGS = {
    "alignment": "trajectory.alignment",
    "windows": "trajectory.time_windows",
    "distances": "trajectory.distance_windows",
    "max_time_difference": "trajectory.max_time_difference",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `improvo evaluate trajectory`."""
    parser.add_argument("estimate", type=Path, metavar="ESTIMATE")
    parser.add_argument("against", type=recording_path, metavar="TRUTH")
    parser.add_argument(
        "--truth",
        metavar="FILE",
        help="TRUTH is a sequence, and these are its true poses: a file of `improvo truth`, a TUM trajectory or the "
        "folder of a COLMAP model",
    )
    add_trajectory_arguments(parser)
    parser.add_argument("-o", "--output", type=Path, metavar="OUT", help="folder for trajectory.json and trajectory.md")
    add_sequence_arguments(parser)
    add_config_arguments(parser)


def add_trajectory_arguments(parser: argparse.ArgumentParser) -> None:
    """Alignment and windows, shared with `improvo evaluate vo`."""
    defaults, absent = TrajectorySettings(), argparse.SUPPRESS
    parser.add_argument(
        "--alignment", choices=ALIGNMENTS, default=absent, help=f"of the estimate (default: {defaults.alignment})"
    )
    windows = " ".join(f"{window:g}" for window in defaults.time_windows)
    parser.add_argument(
        "--windows", nargs="+", type=float, default=absent, help=f"sub-trajectories, seconds (default: {windows})"
    )
    distances = parser.add_mutually_exclusive_group()
    distances.add_argument("--distances", nargs="+", type=float, default=absent, help="sub-trajectories, metres")
    distances.add_argument(
        "--kitti",
        dest="distances",
        action="store_const",
        const=KITTI_LENGTHS,
        default=absent,
        help="sub-trajectories of 100, 200, ... 800 m",
    )
    parser.add_argument(
        "--max-time-difference",
        type=float,
        default=absent,
        metavar="SECONDS",
        help=f"between estimate and truth (default: {defaults.max_time_difference})",
    )


def run(arguments: argparse.Namespace) -> int | None:
    """Print the tables; with -o leave trajectory.json and trajectory.md."""
    from improvo.config import to_dict
    from improvo.evaluation.trajectory.pair import read_pair
    from improvo.evaluation.trajectory.protocol import evaluate_trajectory
    from improvo.evaluation.trajectory.tables import trajectory_tables
    from improvo.files import check_output_folder, make_output_folder, write_json, write_text

    command = settings_from(TrajectoryCommandSettings, arguments, TRAJECTORY_FLAGS)
    settings = command.trajectory
    if arguments.output is not None:
        check_output_folder(arguments.output, COMMAND)
    estimate, truth, notes = read_pair(arguments.estimate, arguments.against, command.sequence, arguments.truth)
    notes = (*notes, *_implausible(truth, arguments.against))
    errors = evaluate_trajectory(estimate, truth, settings, (str(arguments.estimate), str(arguments.against)))
    result = {
        "protocol": "trajectory",
        "estimate": str(arguments.estimate),
        "truth": arguments.truth or str(arguments.against),
        "settings": to_dict(settings),
        **to_dict(errors),
        "notes": list(notes),
    }
    text = trajectory_tables(result, arguments.estimate.name)
    figures(result, text + "".join(f"\n{note}" for note in notes))
    if arguments.output is not None:
        make_output_folder(arguments.output, COMMAND)
        write_json(arguments.output / "trajectory.json", result)
        write_text(arguments.output / "trajectory.md", text)
    next_after_figures(arguments.output)
    return 0


def _implausible(truth: Trajectory, path: Path) -> tuple[str, ...]:
    """A note on true poses whose speed says that they are in other units than metres and seconds."""
    import numpy as np

    steps = np.linalg.norm(np.diff(truth.camera_centers, axis=0), axis=1)
    speeds = (steps / np.maximum(np.diff(truth.times), 1e-9))[np.isfinite(steps)]
    speed = float(np.median(speeds)) if len(speeds) else 0.0
    if speed <= _FASTEST or (path / "run.json").is_file():
        return ()
    return (f"{path}: moves {speed:.3g} m/s; is it in metres and seconds? (millimetres are a thousand times as many)",)
