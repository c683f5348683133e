"""The two trajectories of an evaluation: from files, folders of runs, sequences, or poses in memory."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from improvo.errors import InputError
from improvo.evaluation.truth.reference import lacks_times
from improvo.geometry.trajectory_files import NO_TIMES, has_times, read_trajectory_report
from improvo.odometry.run.run_folder import RunFolder
from improvo.odometry.run.run_json import why_no_pose
from improvo.sequences.base import SequenceSettings
from improvo.sequences.opening import is_recording, true_trajectory
from improvo.types import Trajectory


@dataclass(frozen=True)
class _Side:
    """One of the two: its poses, its name in messages, and what was odd in its file."""

    trajectory: Trajectory
    name: str
    notes: tuple[str, ...] = ()
    counted: bool = False  # rows without times: only their number says which pose of the other each one is


def read_pair(
    estimate: Trajectory | Path,
    truth: Trajectory | Path,
    sequence: SequenceSettings | None = None,
    reference: Path | str | None = None,
) -> tuple[Trajectory, Trajectory, tuple[str, ...]]:
    """Both trajectories, and what was odd in their files. KITTI rows without times count the other's rows.

    Args:
        estimate: poses, a trajectory file, or the folder of a run.
        truth: poses, a trajectory file, the folder of a run, or a sequence, which needs no calibration.
        sequence: how the sequence is read.
        reference: true poses that replace those of the sequence.

    Raises:
        InputError: a file that is no trajectory, a folder without one, a sequence without true poses, a run without
            poses or with several segments as the truth, or KITTI rows without times of which the other has another
            number.
    """
    _refuse_missing(estimate)
    other = _truth(truth, sequence, reference)
    own = _estimate(estimate)
    if own.counted and len(own.trajectory) == len(other.trajectory):
        own = _at_rows_of(own, other)
    elif other.counted and len(own.trajectory) == len(other.trajectory):
        other = _at_rows_of(other, own)
    for side, against in ((own, other), (other, own)):
        if side.counted and len(side.trajectory) != len(against.trajectory):
            raise InputError(
                f"{side.name}: has {len(side.trajectory)} poses without times, and the other "
                f"{len(against.trajectory)}; put a times.txt beside it, or give a TUM file"
            )
    return own.trajectory, other.trajectory, (*own.notes, *other.notes)


def _refuse_missing(estimate: Trajectory | Path) -> None:
    """Refuse an estimate that cannot be read before the truth is opened, which may take long."""
    if isinstance(estimate, Trajectory):
        return
    if (estimate / "run.json").is_file():
        _refuse_without_pose(RunFolder(estimate))
    file = _trajectory_file(estimate)
    if not file.exists():
        raise InputError(f"{file}: no such file; give a trajectory file or the output folder of `improvo run`")


def _trajectory_file(path: Path) -> Path:
    return path / "trajectory.txt" if path.is_dir() else path


def _estimate(given: Trajectory | Path) -> _Side:
    return _Side(given, "the estimate") if isinstance(given, Trajectory) else _of_file(_trajectory_file(given))


def _truth(given: Trajectory | Path, sequence: SequenceSettings | None, reference: Path | str | None) -> _Side:
    if isinstance(given, Trajectory):
        return _Side(given, "the truth")
    if reference is not None:
        from improvo.evaluation.truth.referenced import open_with_truth

        poses = open_with_truth(given, sequence or SequenceSettings(), reference).ground_truth
        assert poses is not None
        return _Side(poses, str(given))
    if lacks_times(given):
        raise InputError(
            f"{given}: has no times; give the sequence as TRUTH, and this with --truth (Python: reference)"
        )
    if (given / "run.json").is_file():
        return _of_run(given)
    if not (given.is_dir() or (given.is_file() and is_recording(given))):
        return _of_file(given)
    found = true_trajectory(given, sequence)
    if found is None:
        raise InputError(f"{given}: has no true poses; give a trajectory file or a sequence that has them")
    return _Side(found, str(given))


def _of_file(path: Path) -> _Side:
    trajectory, notes = read_trajectory_report(path)
    return _Side(trajectory, str(path), notes, counted=not has_times(path))


def _of_run(folder: Path) -> _Side:
    """The trajectory of a run that another is held against, and a note on its unit."""
    run = RunFolder(folder)
    _refuse_without_pose(run)
    segments = len(run.report["segments"])
    if segments > 1:
        raise InputError(
            f"{folder}: its trajectory has {segments} segments, each in a world of its own; a truth needs one"
        )
    return _Side(run.trajectory, str(folder), (f"{folder}: is a run, no ground truth; lengths are {run.unit}",))


def _refuse_without_pose(run: RunFolder) -> None:
    without = why_no_pose(run.report)
    if without is not None:
        raise InputError(f"{run.path}: {without}")


def _at_rows_of(counted: _Side, timed: _Side) -> _Side:
    """Poses without times at the times of the same number of other poses, with a note that says so."""
    rows, poses = len(timed.trajectory), counted.trajectory
    note = f"{counted.name}: has no times; its {rows} poses are taken as the {rows} of {timed.name}, row by row"
    others = tuple(each for each in counted.notes if not each.endswith(NO_TIMES))
    at_times = Trajectory(timed.trajectory.times, poses.world_from_cam, poses.segment)
    return replace(counted, trajectory=at_times, notes=(note, *others))
