"""What was measured of a frontend, and which of two is better."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from improvo.errors import InputError
from improvo.evaluation.statistics import Bootstrap
from improvo.files import write_json
from improvo.improvement.settings import JudgeSettings

_RESAMPLES, _CONFIDENCE = 1000, 0.95


@dataclass(frozen=True)
class Judgement:
    """What was measured on the part that was held back; all candidates on the same frames and pairs."""

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


def rule(settings: JudgeSettings) -> str:
    """The decision rule, in a sentence."""
    return (
        "A frontend is better than the best one before it if more of its matches survive on the frames held back, "
        "summed over the gaps, by more than chance (95 % interval), and the odometry loses with it no more than "
        f"{100 * settings.frames_lost:g} % of the frames that it tracked with the other."
    )


def is_better(candidate: Judgement, best: Judgement, settings: JudgeSettings) -> bool:
    """The rule."""
    kept = candidate.tracked >= (1 - settings.frames_lost) * best.tracked
    return kept and gain_interval(candidate, best)[0] > 0


def gain_interval(candidate: Judgement, before: Judgement, seed: int = 0) -> tuple[float, float]:
    """95 % interval of the gain in score, over paired resamples of the pairs, gap by gap."""
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


def scores(judgement: Judgement, start: Judgement) -> dict[str, float]:
    """What the model card says of the best: surviving matches, its own and those at the start."""
    values = {f"surviving_matches_{gap}": judgement.surviving(gap) for gap in judgement.gaps}
    values |= {f"surviving_matches_{gap}_at_the_start": start.surviving(gap) for gap in start.gaps}
    return {name: round(value, 3) for name, value in values.items()}


def write_judgement(path: Path, judgement: Judgement) -> None:
    """Keep it for later runs, as JSON (which has no NaN)."""
    write_json(path, {**asdict(judgement), "error": None if np.isnan(judgement.error) else judgement.error})


def read_judgement(path: Path) -> Judgement:
    """A judgement of an earlier run.

    Raises:
        InputError: it is damaged.
    """
    try:
        values: dict[str, Any] = json.loads(path.read_text())
        error = float("nan") if values["error"] is None else values["error"]
        return Judgement(**{**values, "error": error, "failures": tuple(values["failures"])})
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{path}: is damaged; remove it, and it is measured again") from None
