"""What is known of a frontend on what was held back, and what it adds to another one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from improvo import config
from improvo.errors import ConfigError, InputError
from improvo.evaluation.pose.self_truth import PairScores, SelfTruthSettings, compare_gaps
from improvo.files import write_json
from improvo.formats import FORMAT, FORMAT_KEY, check_format
from improvo.improvement.settings import ValidationSettings
from improvo.untrusted.text import read_json_file


@dataclass(frozen=True)
class GapScores:
    """The pairs of one recording at one gap, the same ones for every frontend."""

    recording: str
    level: int  # 0 for the nearest gap
    gap: int  # frames
    seconds: float
    pairs: list[list[int]]  # frames of the reference run
    matches: list[int]  # of each pair, whose keypoint has depth
    values: dict[str, list[float]]  # of each pair, see `score_pairs`
    earlier: bool = False  # a recording of a run of the loop before this one: it must not get worse

    def scores(self) -> PairScores:
        """As the judge wants them."""
        values = {name: np.array(each, np.float64) for name, each in self.values.items()}
        return PairScores(self.gap, np.array(self.pairs, np.int64), np.array(self.matches, np.int64), values)


@dataclass(frozen=True)
class Validation:
    """What was measured of a frontend on the part that was held back; of all frontends on the same frames and pairs."""

    frames: int  # that the odometry was given
    tracked: int  # that it gave a pose to
    segments: int  # that the trajectory fell into
    track_length: float  # mean number of frames
    stable_share: float  # stable / (stable + unstable) tracks
    error: float  # median re-projection error of labelled tracks, pixels; NaN without any
    labels: dict[str, int]  # tracks by label
    scores: tuple[GapScores, ...]  # against the reference run
    truth: dict[str, float] = field(default_factory=dict)  # by the pose protocol, where there are depth and true poses
    failures: tuple[str, ...] = ()  # sequences that got no labels, with the reason
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def own(self) -> tuple[GapScores, ...]:
        """The scores without those of recordings of earlier runs."""
        return tuple(scores for scores in self.scores if not scores.earlier)

    @property
    def earlier(self) -> tuple[str, ...]:
        """The recordings of earlier runs."""
        return tuple(dict.fromkeys(scores.recording for scores in self.scores if scores.earlier))

    @property
    def levels(self) -> tuple[int, ...]:
        """The gaps by their number, the nearest first."""
        return tuple(sorted({scores.level for scores in self.own}))

    @property
    def names(self) -> tuple[str, ...]:
        """Of the values of every pair."""
        return tuple(self.scores[0].values)

    def mean(self, name: str, level: int | None = None) -> float:
        """Mean of a value over the pairs of a gap, or of all gaps with the same weight."""
        chosen = [scores for scores in self.own if level in (None, scores.level)]
        return float(np.mean([np.mean(scores.values[name]) for scores in chosen]))

    def pairs(self, level: int) -> int:
        """How many pairs of frames there are of a gap."""
        return sum(len(scores.pairs) for scores in self.own if scores.level == level)

    def gap_words(self, level: int) -> str:
        """The gap in frames and seconds, for a person; the range of it over the recordings."""
        chosen = [scores for scores in self.own if scores.level == level]
        frames = _range([scores.gap for scores in chosen])
        return f"{frames} frames ({_range([scores.seconds for scores in chosen])} s)"


@dataclass(frozen=True)
class Gain:
    """What a frontend adds to another one, over the same pairs."""

    before: float
    after: float
    low: float  # of the 95 % interval of the difference
    high: float

    @property
    def difference(self) -> float:
        """After minus before."""
        return self.after - self.before

    @property
    def relative(self) -> float:
        """The difference as a part of what was before; of one where nothing was."""
        return self.difference / (self.before if self.before > 0 else 1.0)

    @property
    def words(self) -> str:
        """In per cent of what it was before, with the interval."""
        value, interval = self._parts
        return f"{value}, 95 % interval {interval}"

    @property
    def cell(self) -> str:
        """The same for a table that says what stands in brackets."""
        value, interval = self._parts
        return f"{value} ({interval.removesuffix(' %')})"

    @property
    def _parts(self) -> tuple[str, str]:
        if self.before <= 0:
            return f"{self.difference:+.3f}", f"{self.low:+.3f} to {self.high:+.3f}"
        share = 100 / self.before
        return f"{self.difference * share:+.1f} %", f"{self.low * share:+.1f} to {self.high * share:+.1f} %"


def loose(settings: SelfTruthSettings) -> str:
    """One of the two values that decide: the share of matches that are right within the wider limit."""
    return f"right_{settings.right_px[1]:g}px"


def strict(settings: SelfTruthSettings) -> str:
    """The share of matches that are right within the narrower limit."""
    return f"right_{settings.right_px[0]:g}px"


def found(settings: SelfTruthSettings) -> str:
    """The other: how many matches of a pair are right within it; a share also rises where wrong ones are lost."""
    return f"found_{settings.right_px[1]:g}px"


def gain(
    candidate: Validation,
    before: Validation,
    name: str,
    settings: SelfTruthSettings,
    level: int | None = None,
    earlier: str = "",
) -> Gain:
    """What a frontend adds to another one, with the interval over paired resamples of the pairs.

    Args:
        candidate, before: measured on the same pairs.
        name: of the value, or `found(settings)`.
        settings: of the intervals.
        level: of the gap; all gaps together, each with the same weight, where it is None.
        earlier: a recording of an earlier run, in place of those of this one.
    """
    first, second = (
        [
            _only(scores.scores(), name, settings)
            for scores in validation.scores
            if level in (None, scores.level) and earlier == (scores.recording if scores.earlier else "")
        ]
        for validation in (before, candidate)
    )
    compared = compare_gaps(first, second, settings)[name]
    return Gain(compared["first"], compared["second"], *compared["interval"])


def gain_words(validation: Validation, start: Validation, settings: SelfTruthSettings) -> str:
    """What right matches gained over the start in number and share, all gaps together."""
    number, share = (gain(validation, start, name(settings), settings) for name in (found, loose))
    return f"right matches {number.cell}, their share {share.cell} (95 % intervals)"


def summary(validation: Validation, start: Validation, settings: ValidationSettings) -> dict[str, Any]:
    """What the model card says of the best: shares of right matches, its own and those at the start.

    They are by level, since a level is another number of frames in every recording; `level_N` has these in words.
    """
    values: dict[str, Any] = {f"level_{level}": validation.gap_words(level) for level in validation.levels}
    for name in (strict(settings.matches), loose(settings.matches)):
        for level in validation.levels:
            values[f"{name}_level_{level}"] = round(validation.mean(name, level), 4)
            values[f"{name}_level_{level}_at_the_start"] = round(start.mean(name, level), 4)
    return values


def write_validation(path: Path, validation: Validation) -> None:
    """Keep it for later runs, as JSON (which has no NaN)."""
    write_json(
        path,
        {FORMAT_KEY: FORMAT, **asdict(validation), "error": None if np.isnan(validation.error) else validation.error},
    )


def read_validation(path: Path) -> Validation:
    """The validation of an earlier run.

    Raises:
        InputError: it is damaged.
    """
    mend = "remove it, and it is measured again"
    values = read_json_file(path, mend)
    check_format(values.pop(FORMAT_KEY, None), path, mend)
    error = values.get("error", 0.0)
    try:
        read = config.from_dict(Validation, {**values, "error": 0.0 if error is None else error})
        if error is None:  # nothing was tracked; NaN is no JSON, and settings have no NaN
            read = replace(read, error=float("nan"))
        if not (_belongs_together(read) and {"label", "evaluate"} <= read.seconds.keys()):
            raise ConfigError("values that do not belong together")
    except ConfigError:
        raise InputError(f"{path}: is damaged; {mend}") from None
    return read


def _belongs_together(read: Validation) -> bool:
    """Whether the numbers are finite, and every pair has its values."""
    numbers = [read.track_length, read.stable_share, *read.truth.values()]
    for scores in read.scores:
        columns = list(scores.values.values())
        numbers += [scores.seconds, *(value for column in columns for value in column)]
        lengths = {len(scores.pairs), len(scores.matches), *map(len, columns)}
        named = scores.values.keys() == read.scores[0].values.keys()
        if len(lengths) > 1 or not scores.pairs or not named or any(len(pair) != 2 for pair in scores.pairs):
            return False
    return bool(read.scores) and bool(np.isfinite(numbers).all())


def _only(scores: PairScores, name: str, settings: SelfTruthSettings) -> PairScores:
    values = scores.matches * scores.values[loose(settings)] if name == found(settings) else scores.values[name]
    return PairScores(scores.gap, scores.pairs, scores.matches, {name: values})


def _range(values: Sequence[float]) -> str:
    low, high = (f"{value:.3g}" for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"
