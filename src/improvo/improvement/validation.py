"""Measuring a frontend on what was held back, with and without ground truth, and which of two is better."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from improvo import config
from improvo.errors import ConfigError, InputError
from improvo.evaluation.pose.pairs import draw_pairs
from improvo.evaluation.pose.unlabelled import Survival, surviving_matches, usable_gaps
from improvo.evaluation.settings import PoseSettings
from improvo.evaluation.sources import LoadedFrontend, Recorded
from improvo.evaluation.statistics import Bootstrap
from improvo.evaluation.trajectory.protocol import clean_truth
from improvo.files import write_json
from improvo.improvement.folder import Candidate
from improvo.improvement.settings import ValidationSettings
from improvo.improvement.split import Part
from improvo.jobs.pool import Workers
from improvo.labeling.labeled import LabeledSequence, read_labels
from improvo.labeling.store import DONE, SequenceRecord
from improvo.sequences import Sequence, open_sequence
from improvo.stability.rule import IGNORE
from improvo.untrusted.text import read_json_file

_RESAMPLES, _CONFIDENCE = 1000, 0.95


@dataclass(frozen=True)
class Validation:
    """What was measured of a frontend on the part that was held back; of all frontends on the same frames and pairs."""

    frames: int  # that the odometry was given
    tracked: int  # that it gave a pose to
    track_length: float  # mean number of frames
    stable_share: float  # stable / (stable + unstable) tracks
    error: float  # median re-projection error of labelled tracks, pixels; NaN without any
    labels: dict[str, int]  # tracks by label
    agreeing: dict[str, list[int]]  # gap -> surviving matches of every pair
    share: dict[str, float]  # gap -> mean share of keypoints that survive
    pose: dict[str, float] = field(default_factory=dict)  # success rates, where there are depth and true poses
    failures: tuple[str, ...] = ()  # sequences that got no labels, with the reason
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def gaps(self) -> tuple[int, ...]:
        """Frames between the two images of a pair."""
        return tuple(int(gap) for gap in self.agreeing)

    def surviving(self, gap: int) -> float:
        """Mean number of surviving matches of a pair."""
        counts = self.agreeing[str(gap)]
        return float(np.mean(counts)) if counts else 0.0

    @property
    def score(self) -> float:
        """Surviving matches of a pair, summed over the gaps."""
        return sum(self.surviving(gap) for gap in self.gaps)


def rule(settings: ValidationSettings) -> str:
    """The decision rule, in a sentence."""
    return (
        "A frontend is better than the best one before it if more of its matches survive on the frames held back, "
        "summed over the gaps, by more than chance (95 % interval), and the odometry loses with it no more than "
        f"{100 * settings.frames_lost:g} % of the frames that it tracked with the other."
    )


def is_better(candidate: Validation, best: Validation, settings: ValidationSettings) -> bool:
    """Whether a frontend is better than the best one before it; `rule` says it in words.

    Args:
        candidate: what was measured of it.
        best: what was measured of the best one, on the same frames and pairs.
        settings: how many frames it may lose.
    """
    kept = candidate.tracked >= (1 - settings.frames_lost) * best.tracked
    return kept and gain_interval(candidate, best)[0] > 0


def gain_interval(candidate: Validation, before: Validation, seed: int = 0) -> tuple[float, float]:
    """95 % interval of the gain in score, over paired resamples of the pairs, gap by gap.

    Args:
        candidate: what was measured of a frontend.
        before: what was measured of another one, on the same pairs.
        seed: of the resamples.

    Returns:
        Lower and upper bound, in surviving matches.
    """
    gain = spread = 0.0
    for gap in before.gaps:
        gains = np.array(candidate.agreeing[str(gap)]) - np.array(before.agreeing[str(gap)])
        if len(gains) == 0:
            continue
        mean = float(gains.mean())
        lower, upper = Bootstrap(len(gains), seed, _RESAMPLES, _CONFIDENCE).interval(gains)
        gain += mean
        spread += max(upper - mean, mean - lower)  # the gaps share frames: taken as fully dependent
    return gain - spread, gain + spread


def scores(validation: Validation, start: Validation) -> dict[str, float]:
    """What the model card says of the best: surviving matches, its own and those at the start."""
    values = {f"surviving_matches_{gap}": validation.surviving(gap) for gap in validation.gaps}
    values |= {f"surviving_matches_{gap}_at_the_start": start.surviving(gap) for gap in start.gaps}
    return {name: round(value, 3) for name, value in values.items()}


def write_validation(path: Path, validation: Validation) -> None:
    """Keep it for later runs, as JSON (which has no NaN)."""
    write_json(path, {**asdict(validation), "error": None if np.isnan(validation.error) else validation.error})


def read_validation(path: Path) -> Validation:
    """The validation of an earlier run.

    Raises:
        InputError: it is damaged.
    """
    mend = "remove it, and it is measured again"
    values = read_json_file(path, mend)
    error = values.get("error", 0.0)
    try:
        found = config.from_dict(Validation, {**values, "error": float("nan") if error is None else error})
        whole = bool(found.agreeing) and found.agreeing.keys() == found.share.keys()
        whole &= all(gap.isdecimal() and len(gap) < 9 for gap in found.agreeing)
        whole &= {"label", "evaluate"} <= found.seconds.keys()
        numbers = [found.track_length, found.stable_share, *found.share.values(), *found.pose.values()]
        if not (whole and np.isfinite(numbers).all()):
            raise ConfigError("values that do not belong together")
    except ConfigError:
        raise InputError(f"{path}: is damaged; {mend}") from None
    return found


def validate(
    candidate: Candidate,
    part: Part,
    records: list[SequenceRecord],
    settings: ValidationSettings,
    tick: Callable[[], None] = lambda: None,
    progress: bool = False,
) -> Validation:
    """Measure a candidate and keep the result.

    Args:
        candidate: `candidate.held_back` has its labels of the part already.
        part: what was held back.
        records: of those labels.
        settings: of the validation.
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
    validation = Validation(
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
    write_validation(candidate.validation, validation)
    return validation


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
    settings: ValidationSettings,
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
