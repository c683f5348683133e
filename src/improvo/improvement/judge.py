"""Measuring a frontend on what was held back, with and without ground truth."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.evaluation.pose.pairs import draw_pairs
from improvo.evaluation.pose.unlabelled import Survival, surviving_matches, usable_gaps
from improvo.evaluation.settings import PoseSettings
from improvo.evaluation.sources import LoadedFrontend, Recorded
from improvo.evaluation.trajectory.protocol import clean_truth
from improvo.improvement.candidate import Candidate
from improvo.improvement.held_back import Part
from improvo.improvement.judgement import Judgement, write_judgement
from improvo.improvement.settings import JudgeSettings
from improvo.jobs.pool import Workers
from improvo.labeling.labeled import LabeledSequence, read_labels
from improvo.labeling.store import DONE, SequenceRecord
from improvo.sequences import Sequence, open_sequence
from improvo.stability.rule import IGNORE


def judge(
    candidate: Candidate,
    part: Part,
    records: list[SequenceRecord],
    settings: JudgeSettings,
    tick: Callable[[], None] = lambda: None,
    progress: bool = False,
) -> Judgement:
    """Measure a candidate and keep the result.

    Args:
        candidate: `candidate.held_back` has its labels of the part already.
        part: what was held back.
        records: of those labels.
        settings: of the judgement.
        tick: called after every pair of frames.
        progress: whether the pose protocol shows a bar.
    """
    from improvo.frontend.registry import load_frontend

    started = time.perf_counter()
    sequences = [opened for path in part.paths if (opened := _opened(path, part)) is not None]
    gaps = usable_gaps([len(sequence) for sequence in sequences], settings.survival)
    frontend = load_frontend(str(candidate.weights), settings.survival.max_keypoints)
    survivals: list[Survival] = []
    for sequence in sequences:
        survivals += surviving_matches(sequence, frontend, gaps, settings.survival, tick)
    labelled = read_labels(candidate.held_back) if any(record.state == DONE for record in records) else []
    labelling = sum(record.seconds for record in records)
    judgement = Judgement(
        frames=sum(len(sequence) for sequence in sequences),
        tracked=sum(record.tracked for record in records),
        labels={name: sum(getattr(record, name) for record in records) for name in ("stable", "unstable", "ignore")},
        agreeing={str(gap): [int(n) for s in survivals if s.gap == gap for n in s.agreeing] for gap in gaps},
        share={str(gap): _share([s for s in survivals if s.gap == gap]) for gap in gaps},
        pose=_pose_success(candidate, part, sequences, gaps, settings, progress),
        failures=tuple(f"{record.name}: {record.reason}" for record in records if record.state != DONE),
        seconds={"label": round(labelling, 1), "evaluate": round(time.perf_counter() - started, 1)},
        **_of_labels(labelled),
    )
    write_judgement(candidate.judgement, judgement)
    return judgement


def _opened(path: Path, part: Part) -> Sequence | None:
    """The recording; None where it cannot be opened, which labelling has said already."""
    try:
        return open_sequence(path, part.sequence)
    except InputError:
        return None


def _of_labels(labelled: list[LabeledSequence]) -> dict[str, float]:
    """Track length, share of stable tracks and error over the label tables."""
    observations = tracks = stable = with_label = 0
    errors = []
    for sequence in labelled:
        points, rows = sequence.points, sequence.tracks
        observations, tracks = observations + len(rows), tracks + len(points)
        counts = points.counts()
        stable, with_label = stable + counts["stable"], with_label + counts["stable"] + counts["unstable"]
        chosen = np.isin(rows.track, points.track[points.stability != IGNORE]) & np.isfinite(rows.error)
        errors.append(rows.error[chosen])
    known = np.concatenate(errors) if errors else np.zeros(0)
    return {
        "track_length": observations / max(tracks, 1),
        "stable_share": stable / max(with_label, 1),
        "error": float(np.median(known)) if len(known) else float("nan"),
    }


def _share(survivals: list[Survival]) -> float:
    keypoints = np.concatenate([s.keypoints for s in survivals]) if survivals else np.zeros(0)
    agreeing = np.concatenate([s.agreeing for s in survivals]) if survivals else np.zeros(0)
    return float((agreeing / np.maximum(keypoints, 1)).mean()) if len(keypoints) else 0.0


def _pose_success(
    candidate: Candidate,
    part: Part,
    sequences: list[Sequence],
    gaps: tuple[int, ...],
    settings: JudgeSettings,
    progress: bool,
) -> dict[str, float]:
    """Success rates of the pose protocol over the recordings that have depth and true poses; empty without any."""
    from improvo.evaluation.pose.results import results
    from improvo.evaluation.pose.run import run_pose_protocol

    survival = settings.survival
    frontend = LoadedFrontend(str(candidate.weights), survival.max_keypoints, label=candidate.name)
    workers = Workers(1, progress)
    succeeded: defaultdict[str, float] = defaultdict(float)
    pairs: Counter[str] = Counter()
    for number, sequence in enumerate(sequences):
        usable = _gaps_with_truth(sequence, gaps, survival.min_pairs)
        if not usable:
            continue
        protocol = PoseSettings(usable, survival.pairs, max_keypoints=survival.max_keypoints, seed=survival.seed)
        source = Recorded(str(sequence.path), part.sequence)
        run = run_pose_protocol([source], [frontend], protocol, candidate.folder / "features" / str(number), workers)
        for row in results(run)["rows"]:
            for kind in ("rotation", "translation"):
                name = f"{kind}, gap {row['gap']}, {row['estimator']}"
                succeeded[name] += row["pairs"] * row[f"{kind}_success"]
                pairs[name] += row["pairs"]
    return {name: total / pairs[name] for name, total in succeeded.items()}


def _gaps_with_truth(sequence: Sequence, gaps: tuple[int, ...], least: int) -> tuple[int, ...]:
    """The gaps at which the sequence has at least so many pairs with depth and true poses."""

    if sequence.ground_truth is None:
        return ()
    _, unusable = clean_truth(sequence.ground_truth)

    def has_depth(row: int) -> bool:
        depth = sequence.depth(row)
        return depth is not None and bool(np.isfinite(depth).any())

    def enough(gap: int) -> bool:
        return len(draw_pairs(~unusable, has_depth, gap, least, np.random.default_rng(0))) == least

    return tuple(gap for gap in gaps if enough(gap))
