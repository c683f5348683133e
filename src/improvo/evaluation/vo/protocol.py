"""Visual odometry with and without stability weights (paper, "VO Trajectory Evaluation", Table 2)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from improvo.config import to_dict
from improvo.errors import InputError
from improvo.evaluation.settings import TrajectorySettings
from improvo.evaluation.sources import LoadedFrontend, Recorded, refuse_equal_names
from improvo.evaluation.trajectory.protocol import AlignedSegment, aligned_segments, clean_truth, errors_over_windows
from improvo.evaluation.trajectory.protocol import evaluate_trajectory as evaluate
from improvo.frontend.masking import features_of
from improvo.frontend.registry import load_frontend
from improvo.jobs.pool import Workers
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.visual_odometry import VisualOdometry
from improvo.sequences import Sequence
from improvo.types import Features, Trajectory

WITH, WITHOUT = "+stability", "-stability"


@dataclass(frozen=True)
class VoTask:
    """One sequence and one frontend; its features serve both variants."""

    source: Recorded
    frontend: LoadedFrontend
    odometry: OdometrySettings
    trajectory: TrajectorySettings


@dataclass(frozen=True)
class VoOutcome:
    """What one variant did on one sequence."""

    sequence: str
    frontend: str
    variant: str  # WITH, WITHOUT, or "" for a frontend without a stability head
    frames: int  # that were processed
    trajectory: Trajectory
    segments: list[AlignedSegment]  # empty where odometry found no pose
    errors: dict[str, Any] | None  # of this sequence alone; None where odometry found no pose
    note: str


@dataclass(frozen=True)
class ExcludedSequence:
    """A sequence that is left out because of its truth, as the paper does."""

    sequence: str
    reason: str


def run_vo(task: VoTask) -> list[VoOutcome]:
    """Run visual odometry with the stability weights and with all weights 1.

    Raises:
        InputError: the sequence cannot be read.
    """
    sequence = task.source.open()
    frontend = load_frontend(task.frontend.name, task.frontend.max_keypoints)  # as odometry uses it
    detected = [(frame.time, features_of(frontend, frame)) for frame in sequence]
    has_head = any(features.stability is not None for _, features in detected)
    outcomes = []
    for variant in (WITHOUT, WITH) if has_head else ("",):
        odometry = VisualOdometry(frontend, sequence.camera, task.odometry, use_stability=variant == WITH)
        _track(odometry, detected, sequence)
        outcomes.append(_outcome(sequence, task, variant, len(detected), odometry.trajectory))
    return outcomes


def _track(odometry: VisualOdometry, detected: list[tuple[float, Features]], sequence: Sequence) -> None:
    for (time, features), frame in zip(detected, sequence, strict=True):
        odometry.track_features(features, time, frame.image)
    odometry.finish()


def _outcome(sequence: Sequence, task: VoTask, variant: str, frames: int, trajectory: Trajectory) -> VoOutcome:
    truth = sequence.ground_truth
    assert truth is not None  # `usable` has looked
    segments: list[AlignedSegment] = []
    errors, note = None, ""
    try:
        segments = aligned_segments(trajectory, clean_truth(truth)[0], task.trajectory)
        errors = to_dict(evaluate(trajectory, truth, task.trajectory))
    except InputError as error:
        note = str(error) if trajectory.valid.any() else "odometry found no pose"
    return VoOutcome(sequence.name, task.frontend.label, variant, frames, trajectory, segments, errors, note)


def usable(sources: list[Recorded]) -> tuple[list[Recorded], list[ExcludedSequence]]:
    """Sequences whose truth is complete, and those that are left out: the paper excludes any with invalid poses.

    Frames that the truth does not cover, before its first or after its last pose, are no reason.

    Raises:
        InputError: a sequence without any true pose, or none that can be used.
    """
    chosen, excluded = [], []
    for source in sources:
        sequence = source.open()
        truth = sequence.recording.ground_truth
        if truth is None:
            raise InputError(
                f"{source.path}: has no true poses, which this protocol needs; use a sequence that has them"
            )
        invalid = int(clean_truth(truth)[1].sum())
        if invalid:
            reason = f"{invalid} of {len(truth)} true poses are missing, NaN or not rigid"
            excluded.append(ExcludedSequence(sequence.name, reason))
        else:
            chosen.append(source)
    if not chosen:
        raise InputError(f"{sources[0].path}: {excluded[0].reason}; no sequence is left")
    return chosen, excluded


def evaluate_vo(
    sources: list[Recorded],
    frontends: list[LoadedFrontend],
    odometry: OdometrySettings,
    settings: TrajectorySettings,
    workers: Workers | None = None,
) -> tuple[list[VoOutcome], dict[str, Any]]:
    """Table 2 for any frontends.

    Args:
        sources: sequences with true poses; those with invalid ones are left out and named.
        frontends: with different labels; ours alone, as odometry uses them.
        odometry: settings of the odometry.
        settings: of the comparison; windows by share of the path are left to the single sequences.
        workers: processes; by default this one alone.

    Returns:
        The single outcomes, and the content of `vo.json`: `rows` pool the windows of all sequences.

    Raises:
        InputError: a sequence without any true pose, or none that can be used.
        ConfigError: two frontends or sequences of one name.
    """
    refuse_equal_names("frontends", [frontend.label for frontend in frontends])
    refuse_equal_names("sequences", [source.open().name for source in sources])
    chosen, excluded = usable(sources)
    tasks = [VoTask(source, frontend, odometry, settings) for source in chosen for frontend in frontends]
    outcomes = [outcome for found in (workers or Workers()).run(run_vo, tasks, "odometry") for outcome in found]
    pooled = replace(settings, path_fractions=())
    rows = []
    for frontend, variant in dict.fromkeys((o.frontend, o.variant) for o in outcomes):
        own = [o for o in outcomes if (o.frontend, o.variant) == (frontend, variant)]
        relative = errors_over_windows([segment for o in own for segment in _aligned(o)], pooled)
        percents = [o.errors["ate_percent"] for o in own if o.errors and o.errors["ate_percent"] is not None]
        rows.append(
            {
                "frontend": frontend,
                "variant": variant,
                "sequences": len(own),
                "frames": sum(o.frames for o in own),
                "tracked": sum(int(o.trajectory.valid.sum()) for o in own),
                "segments": sum(len(o.segments) for o in own),
                "mean_ate_percent": float(np.mean(percents)) if percents else None,
                "relative": [to_dict(entry) for entry in relative],
            }
        )
    return outcomes, {
        "rows": rows,
        "sequence_rows": [
            {
                "sequence": o.sequence,
                "frontend": o.frontend,
                "variant": o.variant,
                "frames": o.frames,
                "tracked": int(o.trajectory.valid.sum()),
                "note": o.note,
                "errors": o.errors,
            }
            for o in outcomes
        ],
        "excluded": [to_dict(entry) for entry in excluded],
    }


def _aligned(outcome: VoOutcome) -> list[AlignedSegment]:
    return [segment for segment in outcome.segments if segment.motion is not None]
