"""The verdict of a segment: is its path right, as far as its own evidence can tell?"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from improvo.odometry.gates import LARGE_PART, SAME_SCALE
from improvo.odometry.settings import VerdictSettings
from improvo.odometry.verdict.evidence import HALVES, PARTS, QUARTERS, Spread
from improvo.odometry.verdict.seen_again import SeenAgain
from improvo.types import Float64

_SCALE_FACTOR = 6.0  # times what the parts disagree about a scale by (calibrated: docs/log-odometry.md)
_COVERAGE = 1.15  # times the spread, for what all parts are off by together (docs/log-odometry.md)
_USUAL_NOISE = 0.0016  # share of the picture's width; the estimate grows with noise that is larger
_USUAL_SHARED = 0.0007  # the same of what neighbours are off by together: up to 0.0006 by a camera known roughly
_USUAL_VIEWS = 4.0  # keyframes that observe a point; more of them average the noise
_NOISE_POWER = 3  # noise of 1.4 times the usual one came with 3 to 5 times the spread (docs/log-odometry.md)
_FOCAL_CHANGE = 0.12  # of the logarithm of the focal length, within a window or from one to the next
_FOCAL_ERROR = 0.2  # of the logarithm of the focal length, from that of the camera as given
_SIGMAS = 5.0  # standard errors that a deviation of the focal length must exceed
_SIGMAS_OF_GROWTH = 8.0  # its change within a window, which a step ahead imitates; 6.7 at most in right recordings
_RARE = 0.01  # share of windows that say so in right recordings; one of the hundreds of a long one is no alarm
_LARGEST_LENS_ERROR = 0.06  # of the logarithm of a focal length; a window that knows it less well says nothing of it
_SUSPECTED = 0.75  # of the error that a segment may have, where something speaks against it that right ones show, too
_NOT_KNOWN = 0.5  # of the logarithm of a scale: about half or double
_AS_WELL = 1.8  # error of a camera that only turns, over the map's: 1.2 to 1.6 where it did, 9 to 24 where it moved
_MOVED = 0.03  # of the picture's width; what moves less is explained by any camera
RIGHT, DOUBTFUL, NOT_JUDGED = "right", "doubtful", "not judged"


@dataclass(frozen=True)
class Verdict:
    """Whether a segment's path is believed, and why.

    Attributes:
        word: `right`, `doubtful`, or `not judged` where nothing could be measured.
        error_percent: estimated error of the positions after Sim3, % of the segment's own path; NaN: not measured.
        noise_px: of the observations, standard deviation of one coordinate; NaN: not measured.
        evidence: why, in plain words.
        uncertain: first and last frame of each stretch whose scale is not determined.
        limit: of the estimated error, over which the path is doubtful; NaN: it does not decide.
    """

    word: str
    error_percent: float = float("nan")
    noise_px: float = float("nan")
    evidence: tuple[str, ...] = ()
    uncertain: tuple[tuple[int, int], ...] = ()
    limit: float = float("nan")

    def report(self) -> dict[str, Any]:
        """For run.json, which knows no NaN."""
        return {
            "word": self.word,
            "error_percent": _number(self.error_percent),
            "noise_px": _number(self.noise_px),
            "evidence": list(self.evidence),
            "uncertain": [list(stretch) for stretch in self.uncertain],
        }


def judge(
    spread: Spread | None,
    settings: VerdictSettings,
    alarms: tuple[str, ...] = (),
    suspicions: tuple[str, ...] = (),
    suspected: int = 1,
) -> Verdict:
    """The verdict of a segment by the spread of its path, and by what else was seen.

    Args:
        spread: of the paths from the parts of the evidence; None where the segment is too short for one.
        settings: the limits.
        alarms: in plain words; each makes the segment doubtful.
        suspicions: in plain words; where there is one, a smaller error is enough for a doubt.
        suspected: how often; each time three quarters of the error are enough.
    """
    if spread is None:
        return Verdict(DOUBTFUL if alarms else NOT_JUDGED, evidence=(*alarms, "too few keyframes to judge the path"))
    of_lens = _said_of_lens(spread)
    if len(of_lens) > _RARE * len(spread.lens):
        alarms = (*alarms, of_lens[0])
    alarms = (*alarms, *_said_of_turning(spread))
    error = estimated_error(spread)
    uncertain = _uncertain(spread)
    times = suspected if suspicions else 0
    first, last = spread.frames
    if sum(b - a for a, b in uncertain) > LARGE_PART * (last - first) > 0:
        suspicions = (*suspicions, "over a large part of it the scale is not determined")
        times += 1
    limit = settings.max_error * _SUSPECTED**times
    word = RIGHT if error <= limit and not alarms else DOUBTFUL
    if word == RIGHT:  # what speaks for it comes first
        evidence = [_in_words(spread, error), *(f"although {suspicion}" for suspicion in suspicions)]
    else:
        evidence = [*alarms, *suspicions, _in_words(spread, error)]
    evidence += [words for words in of_lens[:1] if words not in alarms]
    evidence += [f"frames {first} to {last}: the scale is not determined" for first, last in uncertain]
    evidence += [_said_of_leap(gap) for gap in spread.leaps]
    return Verdict(word, error, spread.noise_px, tuple(evidence), uncertain, float("nan") if alarms else limit)


def joined(first: Verdict, second: Verdict, scale_error: float, paths: tuple[float, float]) -> Verdict:
    """The verdict of two stretches of one world, with a scale between them that is known to `scale_error` (relative).

    The error of each is a share of its own path, and counts by the share that this has of both paths. The scale between
    them moves half of the path by that share of its size at most. What makes one of them doubtful whatever its error
    makes both so, and the smaller limit counts.

    Args:
        first: of the earlier stretch.
        second: of the later one.
        scale_error: standard error of the scale between them, relative.
        paths: lengths of both, in one unit.
    """
    if NOT_JUDGED in (first.word, second.word):
        return second if first.word == NOT_JUDGED else first
    shares = np.array(paths) / max(sum(paths), 1e-300)
    own = np.array([first.error_percent, second.error_percent])
    error = float(np.nanmax([np.linalg.norm(np.nan_to_num(shares * own)), 50.0 * scale_error]))
    limits = [each.limit for each in (first, second) if np.isfinite(each.limit)]
    alarmed = [each for each in (first, second) if each.word == DOUBTFUL and not np.isfinite(each.limit)]
    doubtful = bool(alarmed) or error > min(limits, default=float("inf"))
    contributions = np.nan_to_num(shares * own)
    worse, better = (first, second) if contributions[0] >= contributions[1] else (second, first)
    if better in alarmed and worse not in alarmed:
        worse, better = better, worse
    return Verdict(
        DOUBTFUL if doubtful else RIGHT,
        error,
        float(np.fmax(first.noise_px, second.noise_px)),
        (
            *(words for words in worse.evidence if not words.startswith("joined, ")),  # the last one tells of all
            *(better.evidence[:1] if better.word == DOUBTFUL else ()),
            f"joined, scale ±{100 * scale_error:.1g} %: estimated error {error:.1f} % of both paths together",
        ),
        (*first.uncertain, *second.uncertain),
        float("nan") if alarmed else min(limits, default=float("nan")),
    )


def estimated_error(spread: Spread) -> float:
    """Error of the segment's positions after Sim3, % of its path.

    The root sum of squares of what the paths of the parts differ by, and of what the least certain change of scale
    moves. Of the two halves of the points the better one counts twice: the other can have too few by chance. Unusual
    noise is worse than its spread: what does not fit is dropped, so what stays agrees with what is wrong. So is what
    neighbours are off by together, which is no noise of keypoints at all: the map follows several motions. Where a
    point is seen by more keyframes than usual, both are averaged over its views, as by the square root of their number.
    """
    averaged = min(float(np.sqrt(_USUAL_VIEWS / max(spread.views_per_point, 1.0))), 1.0)
    noise = averaged * np.nan_to_num(spread.noise_px) / (_USUAL_NOISE * spread.width)
    shared = averaged * spread.shared_px / (_USUAL_SHARED * spread.width)
    quarters, halves = spread.error_percent[: len(QUARTERS)], spread.error_percent[len(QUARTERS) :]
    scale = float(_moved_by_scale(spread).max(initial=0.0))
    spreads = (quarters**2).sum() + len(HALVES) * halves.min() ** 2 + scale**2
    return float(_COVERAGE * max(noise, shared, 1.0) ** _NOISE_POWER * np.sqrt(spreads))


def _scale_errors(spread: Spread) -> Float64:
    """(L,) how much the parts change the scale across each link, median of the absolute logarithms."""
    return np.asarray(np.median(np.abs(spread.scale_steps), axis=1), np.float64)


def _moved_by_scale(spread: Spread) -> Float64:
    """(L,) % of the path that the disagreement of the parts about the scale moves its positions, by each link."""
    return np.asarray(_SCALE_FACTOR * spread.leverage * _scale_errors(spread), np.float64)


def _said_of_lens(spread: Spread) -> tuple[str, ...]:
    """What windows say against that one lens, the camera's, looked at one world that stands still; most telling first.

    A focal length that is not the camera's can be a zoom or a wrong calibration. Where something large moves, too, its
    motion and the camera's fit together only with a focal length that is wrong and changes.
    """
    said: list[str] = []
    sure = [each for each in spread.lens if each.offset_error < _LARGEST_LENS_ERROR]
    for each in spread.lens:
        first, last = each.frames
        if abs(each.growth) > max(_FOCAL_CHANGE, _SIGMAS_OF_GROWTH * each.growth_error):
            said.append(_told(first, last, f"changes by {100 * abs(np.expm1(each.growth)):.0f} %"))
    for each in sure:
        first, last = each.frames
        if abs(each.offset) > max(_FOCAL_ERROR, _SIGMAS * each.offset_error):
            said.append(_told(first, last, f"is {np.exp(each.offset):.2f} times that of the camera as given"))
    for a, b in pairwise(sure):
        change = b.offset - a.offset
        if abs(change) > max(_FOCAL_CHANGE, _SIGMAS * float(np.hypot(a.offset_error, b.offset_error))):
            said.append(_told(a.frames[0], b.frames[1], f"changes by {100 * abs(np.expm1(change)):.0f} %"))
    return tuple(said)


def _said_of_turning(spread: Spread) -> tuple[str, ...]:
    """Whether the camera may have only turned, with another focal length than the one guessed."""
    telling = [each for each in spread.turning if each.moved >= _MOVED]
    turned = [each for each in telling if each.error_px <= _AS_WELL * each.map_px]
    if not turned or len(turned) <= len(telling) / 2:
        return ()
    fov = float(np.median([each.fov for each in turned]))
    return (f"a camera that only turns, {fov:.0f} degrees wide, explains it as well, and how wide it is was a guess",)


def _said_of_leap(gap: SeenAgain) -> str:
    first, last = gap.frames
    seen = f"{gap.found} of {gap.expected} points that should be are seen again"
    return f"frames {first} to {last}: the place may only look like the one before, {seen}"


def _told(first: int, last: int, words: str) -> str:
    return f"frames {first} to {last} fit best if the focal length {words}: a zoom, a wrong calibration, or a mover"


def _uncertain(spread: Spread) -> tuple[tuple[int, int], ...]:
    """Stretches (first and last frame) across which the parts of the evidence disagree about the scale."""
    found: list[tuple[int, int]] = []
    for first, last in sorted(spread.link_frames[_scale_errors(spread) >= SAME_SCALE].tolist()):
        if found and first <= found[-1][1]:
            found[-1] = (found[-1][0], max(last, found[-1][1]))
        else:
            found.append((first, last))
    return tuple(found)


def _in_words(spread: Spread, error: float) -> str:
    """What the estimate rests on, in plain words."""
    if not np.isfinite(error):
        return "no error can be estimated: the path, or that of a part of the evidence, stays on one spot"
    quarters, halves = spread.error_percent[: len(QUARTERS)], spread.error_percent[len(QUARTERS) :]
    worst = int(np.argmax(quarters))
    words = f"estimated error {error:.1f} % of the path: "
    if spread.noise_px > 1.5 * _USUAL_NOISE * spread.width:
        words += f"the points are {spread.noise_px:.1f} pixels off, and "
    if spread.shared_px > 1.25 * _USUAL_SHARED * spread.width:
        words += f"parts of the picture are off by {spread.shared_px:.2f} pixels together, and "
    moved = _moved_by_scale(spread)
    if moved.max(initial=0.0) > float(np.linalg.norm(spread.error_percent)):
        first, last = spread.link_frames[int(np.argmax(moved))].tolist()
        scale = float(_scale_errors(spread)[int(np.argmax(moved))])
        if scale >= _NOT_KNOWN:
            return words + f"nothing tells the scale between frames {first} and {last}"
        share = f"{100 * scale:.1g}" if scale < 0.01 else f"{100 * scale:.0f}"
        only = " only" if scale >= SAME_SCALE else ""
        return words + f"the scale between frames {first} and {last} is known to {share} %{only}"
    if quarters[worst] > 2.0 * halves.max():
        return words + f"{PARTS[worst]} quarter of the picture it differs by {quarters[worst]:.1f} %"
    return words + f"{HALVES[int(np.argmax(halves))]} alone differs by {halves.max():.1f} %"


def _number(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None
