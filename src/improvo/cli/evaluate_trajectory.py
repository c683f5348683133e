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
from improvo.errors import InputError
from improvo.evaluation.settings import ALIGNMENTS, TrajectoryCommandSettings, TrajectorySettings
from improvo.sequences.base import SequenceSettings

if TYPE_CHECKING:
    from improvo.odometry.run_folder import RunFolder
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


def read_pair(
    estimate_path: Path, truth_path: Path, sequence: SequenceSettings | None = None, reference: str | None = None
) -> tuple[Trajectory, Trajectory, tuple[str, ...]]:
    """Both trajectories, and what was odd in their files. KITTI rows without times count the other's rows.

    Args:
        estimate_path: a trajectory file, or the folder of a run.
        truth_path: a trajectory file, the folder of a run, or a sequence.
        sequence: how the sequence is read.
        reference: true poses that replace those of the sequence.

    Raises:
        InputError: a file that is no trajectory, a folder without one, a sequence without true poses, a run without
            poses or with several segments as the truth, or KITTI rows without times of which the other has another
            number.
    """
    from improvo.evaluation.truth.reference import lacks_times
    from improvo.evaluation.truth.referenced import open_with_truth
    from improvo.geometry.trajectory_files import has_times, read_trajectory_report
    from improvo.odometry.run_folder import RunFolder
    from improvo.sequences.opening import true_trajectory

    if (estimate_path / "run.json").is_file():
        _refuse_without_pose(RunFolder(estimate_path))
    estimate_path = estimate_path / "trajectory.txt" if estimate_path.is_dir() else estimate_path
    if not estimate_path.exists():
        raise InputError(f"{estimate_path}: no such file; give a trajectory file or the output folder of `improvo run`")
    counted = not has_times(estimate_path)
    if reference is not None:
        truth = open_with_truth(truth_path, sequence or SequenceSettings(), reference).ground_truth
        truth_notes: tuple[str, ...] = ()
        assert truth is not None
    elif lacks_times(truth_path):
        raise InputError(f"{truth_path}: has no times; give the sequence as TRUTH, and this with --truth")
    elif (truth_path / "run.json").is_file():
        truth, truth_notes = _of_run(truth_path)
    elif truth_path.is_dir():
        truth, truth_notes = true_trajectory(truth_path, sequence), ()
        if truth is None:
            raise InputError(f"{truth_path}: has no true poses; give a trajectory file or a sequence that has them")
    else:
        truth, truth_notes = read_trajectory_report(truth_path)
    estimate, estimate_notes = read_trajectory_report(estimate_path)
    if counted and len(estimate) == len(truth):
        estimate, note = _at_rows_of(estimate, truth, estimate_path, truth_path)
        return estimate, truth, (note, *truth_notes)
    if not truth_path.is_dir() and not has_times(truth_path) and len(estimate) == len(truth):
        truth, note = _at_rows_of(truth, estimate, truth_path, estimate_path)
        return estimate, truth, (*estimate_notes, note)
    for path, rows, other in ((estimate_path, len(estimate), len(truth)), (truth_path, len(truth), len(estimate))):
        if path.is_file() and not has_times(path) and rows != other:
            raise InputError(
                f"{path}: has {rows} poses without times, and the other {other}; put a times.txt beside it, or give a "
                "TUM file"
            )
    return estimate, truth, (*estimate_notes, *truth_notes)


def _implausible(truth: Trajectory, path: Path) -> tuple[str, ...]:
    """A note on true poses whose speed says that they are in other units than metres and seconds."""
    import numpy as np

    steps = np.linalg.norm(np.diff(truth.camera_centers, axis=0), axis=1)
    speeds = (steps / np.maximum(np.diff(truth.times), 1e-9))[np.isfinite(steps)]
    speed = float(np.median(speeds)) if len(speeds) else 0.0
    if speed <= _FASTEST or (path / "run.json").is_file():
        return ()
    return (f"{path}: moves {speed:.3g} m/s; is it in metres and seconds? (millimetres are a thousand times as many)",)


def _refuse_without_pose(run: RunFolder) -> None:
    from improvo.odometry.run_folder import why_no_pose

    without = why_no_pose(run.report)
    if without is not None:
        raise InputError(f"{run.path}: {without}")


def _of_run(folder: Path) -> tuple[Trajectory, tuple[str, ...]]:
    """The trajectory of a run that another is held against, and a note on its unit."""
    from improvo.odometry.run_folder import RunFolder

    run = RunFolder(folder)
    _refuse_without_pose(run)
    segments = len(run.report["segments"])
    if segments > 1:
        raise InputError(
            f"{folder}: its trajectory has {segments} segments, each in a world of its own; a truth needs one"
        )
    return run.trajectory, (f"{folder}: is a run, no ground truth; lengths are {run.unit}",)


def _at_rows_of(counted: Trajectory, timed: Trajectory, path: Path, other: Path) -> tuple[Trajectory, str]:
    """Poses without times at the times of the same number of other poses, and a note that says so."""
    from improvo.types import Trajectory

    note = f"{path}: has no times; its {len(timed)} poses are taken as the {len(timed)} of {other}, row by row"
    return Trajectory(timed.times, counted.world_from_cam, counted.segment), note
