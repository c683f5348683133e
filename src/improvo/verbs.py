"""The verbs of the Python API: what the commands do, as functions that return a typed result and print nothing.

Each opens its input and calls the room that does the work. The commands (`cli`) call the same rooms themselves, since
they show progress on the way. Heavy libraries load when a verb is called.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from improvo.locations import local_folder, publish

if TYPE_CHECKING:
    from improvo.evaluation.settings import PoseSettings, TrajectorySettings
    from improvo.evaluation.trajectory.protocol import TrajectoryErrors
    from improvo.frontend import Frontend
    from improvo.frontend.weights_files import DataSource
    from improvo.improvement.improve import Improvement
    from improvo.improvement.settings import ImproveSettings
    from improvo.labeling.labeler import LabeledRun
    from improvo.labeling.store import SequenceRecord
    from improvo.odometry.run_settings import RunSettings
    from improvo.self_calibration.from_motion import CameraFromMotion
    from improvo.self_calibration.settings import SelfCalibrationSettings
    from improvo.sequences import Sequence as ImageSequence
    from improvo.sequences import SequenceSettings
    from improvo.training.settings import OdometryTrainingSettings
    from improvo.types import Trajectory

PathLike = str | Path


def _each(paths: PathLike | Sequence[PathLike]) -> list[PathLike]:
    """A list also of a single path, whose letters would else be taken for paths."""
    return [paths] if isinstance(paths, str | Path) else list(paths)


def run(
    sequence: ImageSequence | PathLike,
    output: PathLike,
    settings: RunSettings | None = None,
    frontend: Frontend | None = None,
) -> LabeledRun:
    """Visual odometry on one sequence, as `improvo run` does it.

    Args:
        sequence: an open sequence, or the path of anything that `open_sequence` recognises.
        output: folder for trajectory, map, tracks, labels and report.
        settings: all numbers; `preset(RunSettings, "paper")` has the paper's. With `DenseRunSettings(dense=True)` the
            folder gets depth maps and a cloud too.
        frontend: in place of the one that the settings name.

    Raises:
        InputError: the sequence cannot be opened, has too few frames, or is live where depth is wanted.
        OutputError: the folder cannot be used.
    """
    from improvo.depth.dense import refuse_live, write_dense
    from improvo.depth.run_settings import DenseRunSettings
    from improvo.folder_lock import working_in
    from improvo.labeling.labeler import run_and_label
    from improvo.odometry.run_settings import RunSettings
    from improvo.odometry.scale.apply import apply_scale
    from improvo.odometry.scale.settings import ScaleSettings
    from improvo.odometry.scale.sources import scale_source
    from improvo.self_calibration.found_cameras import with_camera_note
    from improvo.sequences import open_sequence
    from improvo.sequences.rates import AUTO

    settings = settings or RunSettings()
    folder = local_folder(output)
    if isinstance(sequence, str | Path):
        if settings.sequence.camera == AUTO:
            settings = replace(settings, sequence=_found([sequence], settings.sequence, folder, "run"))
        sequence = open_sequence(sequence, settings.sequence)
    depth = settings.depth if isinstance(settings, DenseRunSettings) and settings.dense else None
    if depth is not None:
        refuse_live(sequence)
    scale = settings.scale if isinstance(settings, DenseRunSettings) else ScaleSettings()
    ask = scale_source(sequence, scale)  # before any work
    with working_in(folder, "run"):
        result = run_and_label(sequence, folder, settings, frontend=frontend)
        result = with_camera_note(result, settings.sequence.camera)
        if ask is not None:
            result = apply_scale(sequence, result, ask, scale)
        if depth is not None and not result.report["interrupted"]:
            write_dense(sequence, result, depth)
    publish(folder)
    return result


def label(
    sequences: PathLike | Sequence[PathLike],
    output: PathLike,
    settings: RunSettings | None = None,
    workers: int | None = None,
    ray: str | None = None,
) -> list[SequenceRecord]:
    """Stability labels for many sequences, as `improvo label` makes them; what is done already is not done again.

    Args:
        sequences: paths of recordings, or one path.
        output: folder of the label store.
        settings: all numbers; by default those of `LabelRunSettings`.
        workers: sequences at a time, a process with one core for each; by default one, in this process, on all cores.
        ray: address of a Ray cluster that does the work.

    Returns:
        One record for each sequence, in their order; `reason` says why one has no labels.

    Raises:
        InputError: none of them could be labelled.
        ConfigError: the store was made with other settings.
    """
    from improvo.labeling.label_sequences import label_sequences
    from improvo.odometry.run_settings import LabelRunSettings

    chosen = settings or LabelRunSettings()
    folder = local_folder(output)
    recordings = [Path(path) for path in _each(sequences)]
    chosen = replace(chosen, sequence=_found(recordings, chosen.sequence, folder, "label"))
    records = label_sequences(recordings, folder, chosen, workers, ray=ray)
    publish(folder)
    return records


def find_camera(sequence: PathLike, settings: SelfCalibrationSettings | None = None) -> CameraFromMotion:
    """The camera of a video from its own motion, as `improvo calibrate` finds it without a board.

    Args:
        sequence: path of a recording whose camera moves sideways and turns.
        settings: all numbers.

    Returns:
        Camera, standard deviations, and `write("camera.yaml")`.

    Raises:
        InputError: the recording cannot be read, or its motion leaves the camera open.
    """
    from improvo.self_calibration.from_motion import camera_from_motion

    return camera_from_motion(sequence, settings)


def _found(sequences: Sequence[PathLike], settings: SequenceSettings, folder: Path, command: str) -> SequenceSettings:
    """Settings with files in place of the camera `auto`, which are left in the output folder."""
    from improvo.files import make_output_folder
    from improvo.self_calibration.found_cameras import find_cameras
    from improvo.sequences.rates import AUTO

    if settings.camera != AUTO:
        return settings
    make_output_folder(folder, command)
    return find_cameras([Path(path) for path in sequences], settings, folder)


@dataclass(frozen=True)
class Trained:
    """What a training stage leaves."""

    weights: Path  # a file that `load_frontend` takes
    metrics: dict[str, float]  # the last row of metrics.jsonl


def train_odometry(
    labels: PathLike | Sequence[PathLike],
    output: PathLike,
    settings: OdometryTrainingSettings | None = None,
    start: PathLike = "superpoint",
    pictures: str | Sequence[str] = (),
    data: Sequence[DataSource] = (),
) -> Trained:
    """VO adaptation, as `improvo train odometry` does it (needs the extra `train`).

    Args:
        labels: label stores, as `label` makes them, or one.
        output: folder for weights, metrics and checkpoints; an unfinished one is continued.
        settings: all numbers.
        start: weights to start from, a bundled name or a file.
        pictures: sources of homography pairs that are trained on beside the labels.
        data: what the model card says about the recordings.

    Raises:
        MissingExtraError: torch is not installed.
        InputError: no labels that teach anything.
    """
    from improvo.frontend.weights_files import find_weights
    from improvo.training.settings import OdometryTrainingSettings

    need_torch()
    from improvo.training.odometry_training import train_odometry

    settings, folder = settings or OdometryTrainingSettings(), local_folder(output)
    metrics = train_odometry(
        [local_folder(path, writing=False) for path in _each(labels)],
        settings,
        folder,
        find_weights(start),
        tuple(data),
        progress=False,
        pictures=[pictures] if isinstance(pictures, str) else list(pictures),
    )
    publish(folder)
    return Trained(folder / "weights.safetensors", metrics)


def need_torch() -> None:
    """Refuse to train without torch and SciPy, before any work is done.

    Raises:
        MissingExtraError: one of them is not installed.
    """
    from improvo.errors import MissingExtraError, installed

    if not (installed("torch") and installed("scipy")):
        raise MissingExtraError("training", "train")


def improve(
    sequences: PathLike | Sequence[PathLike],
    output: PathLike,
    settings: ImproveSettings | None = None,
    rounds: int | None = None,
    evaluate: PathLike | Sequence[PathLike] = (),
    workers: int | None = None,
    after: PathLike | None = None,
) -> Improvement:
    """The loop: label, train, validate, and keep the better weights, as `improvo improve` does it.

    Args:
        sequences: recordings without ground truth, or one; part of them is held out.
        output: folder for weights, rounds and report; an unfinished one is continued.
        settings: all numbers.
        rounds: of training and validation; by default two, or one where that is not better or two take too long.
        evaluate: recordings to hold out; without any, some of `sequences`, or the last part of a single one.
        workers: sequences labelled at a time, a process with one core for each; by default one, in this process.
        after: finished folder of an earlier call, whose recordings are replayed and must not get worse.

    Raises:
        MissingExtraError: torch is not installed.
        InputError: nothing could be labelled.
        ConfigError: the folder was begun with other settings.
    """
    need_torch()
    from improvo.improvement.improve import improve as run_rounds
    from improvo.improvement.settings import ImproveSettings

    recordings, held_out = [Path(path) for path in _each(sequences)], [Path(path) for path in _each(evaluate)]
    folder = local_folder(output)
    settings = settings or ImproveSettings()
    settings = replace(settings, sequence=_found([*recordings, *held_out], settings.sequence, folder, "improve"))
    before = local_folder(after) if after is not None else None
    result = run_rounds(recordings, folder, settings, rounds, held_out, workers, after=before)
    publish(folder)
    return result


@dataclass(frozen=True)
class PoseAccuracy:
    """A cell of Table 1: how often the relative pose of two images is right."""

    frontend: str
    estimator: str  # the solver: opencv, poselib or usac
    gap: int  # frames between the two images
    pairs: int
    rotation_success: float  # share of the pairs with less than the largest rotation error (5 degrees)
    translation_success: float  # share with less than the largest translation error (5 cm)
    rotation_interval: tuple[float, float]  # of the share, by bootstrap
    translation_interval: tuple[float, float]


def evaluate_pose(
    sequences: PathLike | Sequence[PathLike],
    frontends: str | Sequence[str],
    settings: PoseSettings | None = None,
    sequence_settings: SequenceSettings | None = None,
    workers: int = 1,
) -> list[PoseAccuracy]:
    """3D-to-2D pose estimation (paper, Table 1), as `improvo evaluate pose` does it.

    Args:
        sequences: recordings with depth and true poses, or one.
        frontends: bundled names, weights files or peers; all get the same pairs.
        settings: of the protocol.
        sequence_settings: how the recordings are read.
        workers: processes.

    Raises:
        InputError: a recording without depth or poses, or a gap without pairs.
    """
    import tempfile

    from improvo.evaluation.pose.gaps import with_gaps_in_frames
    from improvo.evaluation.pose.results import results
    from improvo.evaluation.pose.run import run_pose_protocol
    from improvo.evaluation.settings import PoseSettings
    from improvo.evaluation.sources import LoadedFrontend, Recorded
    from improvo.jobs.pool import Workers
    from improvo.sequences import SequenceSettings

    settings = settings or PoseSettings()
    sources = [Recorded(str(path), sequence_settings or SequenceSettings()) for path in _each(sequences)]
    settings = with_gaps_in_frames(settings, [source.open() for source in sources])
    loaded = [
        LoadedFrontend(name, settings.max_keypoints)
        for name in ([frontends] if isinstance(frontends, str) else frontends)
    ]
    for frontend in loaded:
        frontend.check()
    with tempfile.TemporaryDirectory(prefix="improvo-") as cache, Workers(workers) as pool:
        rows = results(run_pose_protocol(list(sources), list(loaded), settings, Path(cache), pool))["rows"]
    return [
        PoseAccuracy(
            row["frontend"],
            row["estimator"],
            row["gap"],
            row["pairs"],
            row["rotation_success"],
            row["translation_success"],
            tuple(row["rotation_success_interval"]),
            tuple(row["translation_success_interval"]),
        )
        for row in rows
    ]


def evaluate_trajectory(
    estimate: Trajectory | PathLike,
    truth: Trajectory | PathLike,
    settings: TrajectorySettings | None = None,
    sequence_settings: SequenceSettings | None = None,
    reference: PathLike | None = None,
) -> TrajectoryErrors:
    """Errors of a trajectory against the truth (paper, Table 2), as `improvo evaluate trajectory` has them.

    Args:
        estimate: poses, a trajectory file, or the output folder of a run.
        truth: poses, a trajectory file, the output folder of a run, or a sequence that has true poses; it needs no
            calibration.
        settings: alignment and the lengths of sub-trajectories.
        sequence_settings: how the sequence is read, where `truth` is one.
        reference: true poses that replace those of the sequence `truth`, and say by frame numbers or image names
            which frames they belong to: a file of `improvo truth` (`truth-sfm.txt`) or the folder of a COLMAP model;
            or a TUM trajectory.

    Rows of a KITTI file without times are taken as the rows of the other, one by one.

    Raises:
        TypeError: neither poses nor a path, or a reference without a sequence.
        InputError: a file that is no trajectory, a sequence without true poses, rows without times of which the
            other has another number, or no common time.
    """
    from improvo.evaluation.settings import TrajectorySettings
    from improvo.evaluation.trajectory.pair import read_pair
    from improvo.evaluation.trajectory.protocol import evaluate_trajectory as errors_of

    own, against = _poses_or_path(estimate), _poses_or_path(truth)
    if reference is not None and not isinstance(against, Path):
        raise TypeError("reference: its poses belong to frames of a recording; give its path as `truth`")
    ours, true, _ = read_pair(own, against, sequence_settings, reference)
    names = (_name_of(estimate, "the estimate"), _name_of(truth, "the truth"))
    return errors_of(ours, true, settings or TrajectorySettings(), names)


def _poses_or_path(given: object) -> Trajectory | Path:
    from improvo.types import Trajectory

    if isinstance(given, Trajectory):
        return given
    if not isinstance(given, str | Path):
        mend = "give a path or a `Trajectory`, such as `odometry.trajectory` or `sequence.ground_truth`"
        raise TypeError(f"trajectory: is a {type(given).__name__}; {mend}")
    return Path(given)


def _name_of(given: Trajectory | PathLike, otherwise: str) -> str:
    return str(given) if isinstance(given, str | Path) else otherwise
