"""A trajectory against the truth (Zhang and Scaramuzza 2018): absolute error, relative errors over sub-trajectories.

ESTIMATE is a TUM, KITTI or EuRoC file, or the output folder of `sivo run`; TRUTH such a file, or a sequence that has
true poses. Segments of an estimate (`# segment N` lines) are aligned each on its own.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from sivo.errors import InputError

if TYPE_CHECKING:
    from sivo.evaluation.trajectory import TrajectorySettings
    from sivo.types import Trajectory

COMMAND = "evaluate trajectory"
KITTI_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `sivo evaluate trajectory`."""
    parser.add_argument("estimate", type=Path, metavar="ESTIMATE")
    parser.add_argument("truth", type=Path, metavar="TRUTH")
    add_trajectory_arguments(parser)
    parser.add_argument("-o", "--output", type=Path, metavar="OUT", help="folder for trajectory.json and trajectory.md")


def add_trajectory_arguments(parser: argparse.ArgumentParser) -> None:
    """Alignment and windows, shared with `sivo evaluate vo`."""
    parser.add_argument("--alignment", choices=("sim3", "se3", "none"), default="sim3", help="of the estimate")
    parser.add_argument("--windows", nargs="+", type=float, default=[2.0, 5.0, 10.0], help="sub-trajectories, seconds")
    parser.add_argument("--distances", nargs="*", type=float, default=[], help="sub-trajectories, metres")
    parser.add_argument("--kitti", action="store_true", help="sub-trajectories of 100, 200, ... 800 m")
    parser.add_argument("--max-time-difference", type=float, default=0.02, help="between estimate and truth, seconds")


def trajectory_settings(arguments: argparse.Namespace) -> TrajectorySettings:
    """The settings that the arguments of `add_trajectory_arguments` mean."""
    from sivo.evaluation.trajectory import TrajectorySettings

    return TrajectorySettings(
        alignment=arguments.alignment,
        max_time_difference=arguments.max_time_difference,
        time_windows=tuple(arguments.windows),
        distance_windows=(*arguments.distances, *(KITTI_LENGTHS if arguments.kitti else ())),
    )


def run(arguments: argparse.Namespace) -> int | None:
    """Print the tables; with -o leave trajectory.json and trajectory.md."""
    from sivo.config import to_dict
    from sivo.evaluation.trajectory import evaluate_trajectory
    from sivo.evaluation.trajectory_tables import trajectory_tables
    from sivo.files import make_output_folder, write_json, write_text

    settings = trajectory_settings(arguments)
    if arguments.output is not None:
        make_output_folder(arguments.output, COMMAND)
    estimate, truth, notes = read_pair(arguments.estimate, arguments.truth)
    errors = evaluate_trajectory(estimate, truth, settings, (str(arguments.estimate), str(arguments.truth)))
    result = {
        "protocol": "trajectory",
        "estimate": str(arguments.estimate),
        "truth": str(arguments.truth),
        "settings": to_dict(settings),
        **to_dict(errors),
        "notes": list(notes),
    }
    text = trajectory_tables(result, arguments.estimate.name)
    print(text + "".join(f"\n{note}" for note in notes), end="\n" if notes else "")
    if arguments.output is not None:
        write_json(arguments.output / "trajectory.json", result)
        write_text(arguments.output / "trajectory.md", text)
    return 0


def read_pair(estimate_path: Path, truth_path: Path) -> tuple[Trajectory, Trajectory, tuple[str, ...]]:
    """Both trajectories, and what was odd in their files. Two KITTI files of one length count the same frames.

    Raises:
        InputError: a file that is no trajectory, a folder without one, a sequence without true poses.
    """
    from sivo.sequences import open_sequence
    from sivo.sequences.trajectory_files import read_trajectory_report
    from sivo.types import Trajectory

    if truth_path.is_dir():
        truth, truth_notes = open_sequence(truth_path).ground_truth, tuple[str, ...]()
        if truth is None:
            raise InputError(f"{truth_path}: has no true poses; give a trajectory file or a sequence that has them")
    else:
        truth, truth_notes = read_trajectory_report(truth_path)
    if estimate_path.is_dir():
        estimate_path = estimate_path / "trajectory.txt"
    estimate, estimate_notes = read_trajectory_report(estimate_path)
    if _columns(estimate_path) == _columns(truth_path) == 12 and len(estimate) == len(truth):
        estimate = Trajectory(truth.times, estimate.world_from_cam, estimate.segment)
    return estimate, truth, (*estimate_notes, *truth_notes)


def _columns(path: Path) -> int:
    if not path.is_file():
        return 0
    lines = (line for line in path.read_text().splitlines() if line.strip() and not line.startswith("#"))
    return len(next(lines, "").split())
