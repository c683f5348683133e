"""Measuring a frontend on what was held back, without ground truth, and with it where there is some."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from improvo.errors import InputError
from improvo.evaluation.pose.pairs import draw_pairs
from improvo.evaluation.pose.self_truth import FixedRun, choose_pairs, score_pairs
from improvo.evaluation.settings import PoseSettings
from improvo.evaluation.sources import LoadedFrontend, Recorded
from improvo.evaluation.trajectory.protocol import clean_truth
from improvo.frontend import Frontend
from improvo.improvement.folder import Candidate
from improvo.improvement.gaps import choose_gaps
from improvo.improvement.reference import ReferencePart
from improvo.improvement.settings import ValidationSettings
from improvo.improvement.split import Part
from improvo.improvement.validation import GapScores, Validation, write_validation
from improvo.jobs.crew import Crew
from improvo.jobs.pool import Workers
from improvo.labeling.labeled import LabeledSequence, read_labels
from improvo.labeling.store import DONE, SequenceRecord
from improvo.locations import fetched
from improvo.sequences import Sequence as ImageSequence
from improvo.sequences import open_sequence
from improvo.stability.rule import IGNORE
from improvo.stability.tables import POINTS_FILE, TRACKS_FILE, read_observations, read_points_parts
from improvo.types import Features, Int64


def validate(
    candidate: Candidate,
    part: Part,
    reference: Sequence[ReferencePart],
    records: list[SequenceRecord],
    settings: ValidationSettings,
    tick: Callable[[int], None] = lambda count: None,
    progress: bool = False,
    crew: Crew = Crew(),  # noqa: B008 - it is frozen
) -> Validation:
    """Measure a candidate and keep the result.

    Args:
        candidate: `candidate.held_back` has its labels of the part already.
        part: what was held back.
        reference: the same for all candidates.
        records: of those labels.
        settings: of the validation.
        tick: is told that so many more pairs of frames are done.
        progress: whether the pose protocol shows a bar.
        crew: who measures, a recording each.

    Raises:
        InputError: no pair of frames has poses and depth.
    """
    started = time.perf_counter()
    jobs = [ScoreJob(one, candidate.weights, settings) for one in reference]
    scores = [entry for found in crew.results(scores_of, jobs, tick) for entry in found]
    if all(entry.earlier for entry in scores):
        raise InputError(
            "what is held back has no pair of frames with poses and depth; hold back a longer or livelier recording "
            "with --evaluate, or more of this one with --set split.share=0.5 and another -o"
        )
    labelled = read_labels(candidate.held_back) if any(record.state == DONE for record in records) else []
    gaps = tuple(sorted({entry.gap for entry in scores if not entry.earlier}))
    validation = Validation(
        frames=sum(len(one.frames) for one in reference if not one.earlier),
        tracked=sum(record.tracked for record in records),
        segments=sum(record.segments for record in records),
        labels={name: sum(getattr(record, name) for record in records) for name in ("stable", "unstable", "ignore")},
        scores=tuple(scores),
        truth=_truth(candidate, part, gaps, settings, progress),
        failures=tuple(f"{record.name}: {record.reason}" for record in records if record.state != DONE),
        seconds={
            "label": round(sum(record.seconds for record in records), 1),
            "evaluate": round(time.perf_counter() - started, 1),
        },
        **_of_labels(labelled),
    )
    write_validation(candidate.validation, validation)
    return validation


def pairs_of(run: FixedRun, settings: ValidationSettings) -> list[Int64]:
    """Pairs (K, 2) of frames, gap by gap, the nearest first."""
    gaps = settings.gaps or choose_gaps(run, settings.overlaps, settings.min_pairs)
    chosen = [choose_pairs(run, gap, settings.matches.pairs) for gap in gaps]
    return [pairs for pairs in chosen if len(pairs)]


@dataclass(frozen=True)
class ScoreJob:
    """A recording to measure a frontend on."""

    reference: ReferencePart
    weights: Path
    settings: ValidationSettings


def scores_of(job: ScoreJob, tick: Callable[[], None]) -> list[GapScores]:
    """Of the pairs of one recording, gap by gap; `tick` is called after every pair."""
    frontend = _loaded(job.weights, job.settings.matches.max_keypoints, job.weights.stat().st_mtime_ns)
    return _scores(job.reference, frontend, job.settings, tick)


@lru_cache(maxsize=1)
def _loaded(weights: Path, max_keypoints: int, written: int) -> Frontend:
    """The frontend of the recording before it, too; loading takes a second."""
    from improvo.frontend.registry import load_frontend

    return load_frontend(str(weights), max_keypoints)


def _scores(
    reference: ReferencePart, frontend: Frontend, settings: ValidationSettings, tick: Callable[[], None]
) -> list[GapScores]:
    run, times = reference.fixed_run(), reference.labeled.frames.time

    @cache
    def features(frame: int) -> Features:
        return reference.features(frontend, frame)

    found = []
    for level, pairs in enumerate(pairs_of(run, settings)):
        scores = score_pairs(run, features, pairs, settings.matches, tick)
        seconds = float(np.median(times[pairs[:, 1]] - times[pairs[:, 0]]))
        values = {name: [round(float(value), 6) for value in each] for name, each in scores.values.items()}
        where = reference.name, level, scores.gap, round(seconds, 3)
        found.append(GapScores(*where, pairs.tolist(), scores.matches.tolist(), values, reference.earlier))
    return found


def _of_labels(labelled: list[LabeledSequence]) -> dict[str, float]:
    """Track length, share of stable tracks and error over the label tables."""
    observations = tracks = stable = with_label = 0
    errors = []
    for sequence in labelled:  # a part at a time: a long recording does not fit into memory
        labels = []
        for points in read_points_parts(fetched(sequence.folder / POINTS_FILE)):
            tracks += len(points)
            counts = points.counts()
            stable, with_label = stable + counts["stable"], with_label + counts["stable"] + counts["unstable"]
            labels.append(points.track[points.stability != IGNORE])
        taught = np.concatenate(labels) if labels else np.zeros(0, np.int64)
        for rows in read_observations(fetched(sequence.folder / TRACKS_FILE)):
            observations += len(rows.error)
            errors.append(rows.error[np.isin(rows.track, taught) & np.isfinite(rows.error)])
    known = np.concatenate(errors) if errors else np.zeros(0)
    return {
        "track_length": observations / max(tracks, 1),
        "stable_share": stable / max(with_label, 1),
        "error": float(np.median(known)) if len(known) else float("nan"),
    }


def _truth(
    candidate: Candidate, part: Part, gaps: tuple[int, ...], settings: ValidationSettings, progress: bool
) -> dict[str, float]:
    """The pose protocol over the recordings that have depth and true poses; empty without any."""
    from improvo.evaluation.pose.results import results
    from improvo.evaluation.pose.run import run_pose_protocol

    matches = settings.matches
    frontend = LoadedFrontend(str(candidate.weights), matches.max_keypoints, label=candidate.name)
    workers = Workers(1, progress)
    sums: defaultdict[str, float] = defaultdict(float)
    pairs: Counter[str] = Counter()
    for number, path in enumerate(part.paths):
        usable = _gaps_with_truth(path, part, gaps, settings.min_pairs)
        if not usable:
            continue
        protocol = PoseSettings(
            gaps=usable, pairs=matches.pairs, max_keypoints=matches.max_keypoints, seed=matches.seed,
            shuffles=matches.shuffles, right_px=matches.right_px,
        )  # fmt: skip
        run = run_pose_protocol(
            [Recorded(str(path), part.sequence)], [frontend], protocol, candidate.folder / "features" / str(number),
            workers,
        )  # fmt: skip
        for row in results(run)["rows"]:
            for name, value in _truth_of(row, matches.right_px, protocol.estimators[0]).items():
                sums[name] += row["pairs"] * value
                pairs[name] += row["pairs"]
    return {name: total / pairs[name] for name, total in sums.items()}


def _truth_of(row: dict[str, Any], limits: tuple[float, float], solver: str) -> dict[str, float]:
    """What a row of `pose.json` says, by name; the matches, which no solver sees, once."""
    gap, estimator = row["gap"], row["estimator"]
    values = {f"{kind}, gap {gap}, {estimator}": row[f"{kind}_success"] for kind in ("rotation", "translation")}
    if estimator == solver:
        values |= {f"right within {limit:g} px, gap {gap}": row[f"right_share_{limit:g}px"] for limit in limits}
    return values


def _gaps_with_truth(path: Path, part: Part, gaps: tuple[int, ...], least: int) -> tuple[int, ...]:
    """The gaps at which the recording has at least so many pairs with depth and true poses."""
    try:
        sequence: ImageSequence = open_sequence(path, part.sequence)
    except InputError:  # labelling has said so
        return ()
    if sequence.ground_truth is None:
        return ()
    _, unusable = clean_truth(sequence.ground_truth)

    def has_depth(row: int) -> bool:
        depth = sequence.depth(row)
        return depth is not None and bool(np.isfinite(depth).any())

    def enough(gap: int) -> bool:
        return len(draw_pairs(~unusable, has_depth, gap, least, np.random.default_rng(0))) == least

    return tuple(gap for gap in gaps if enough(gap))
