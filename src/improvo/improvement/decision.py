"""Which of two frontends is better on what was held back, and why one is not."""

from __future__ import annotations

from collections.abc import Iterator

from improvo.improvement.settings import ValidationSettings
from improvo.improvement.validation import Gain, Validation, found, gain, loose


def rule(settings: ValidationSettings, earlier: bool = False) -> str:
    """The decision rule, in words.

    Args:
        settings: of the validation.
        earlier: whether there are recordings of earlier runs.
    """
    words = (
        f"A frontend is better than the one at the start if, on the frames held back, more of its matches are right "
        f"within {settings.matches.right_px[1]:g} pixels, or a larger share of them is, by more than chance (95 % "
        f"interval, all gaps together), and if neither is less by more than chance; better than the best one before it "
        f"if number and share together are larger and neither is less by more than chance; and if the odometry is not "
        f"worse with it: it loses no more than {100 * settings.frames_lost:g} % of the frames that it tracked with the "
        f"other, and breaks no more often."
    )
    return f"{words} In no recording of an earlier run may the share be less by more than chance." if earlier else words


def why_not_better(candidate: Validation, best: Validation, start: Validation, settings: ValidationSettings) -> str:
    """What a frontend lacks to be better than the best one before it, in words; empty where it is. `rule` is the rule.

    That it is better than the start must be more than chance. Between two that are, the one with the larger sum of
    what number and share gained is the better guess, although the difference may be chance.

    Args:
        candidate: what was measured of it.
        best: what was measured of the best one, on the same frames and pairs.
        start: what was measured at the start, likewise; the same as `best` for a first round.
        settings: what its odometry may lose.
    """
    judge = settings.matches
    rivals = (start,) if best is start else (start, best)
    gains = [[gain(candidate, before, name(judge), judge) for name in (found, loose)] for before in rivals]
    faults = []
    if not any(one.low > 0 for one in gains[0]):
        faults.append("neither number nor share of right matches is larger than at the start by more than chance")
    elif not sum(one.relative for one in gains[-1]) > 0:
        faults.append(f"number and share of right matches together are no larger than {_named(best, start)}")
    for before, (number, share) in zip(rivals, gains, strict=True):
        faults += _losses(candidate, before, number, share, _named(before, start), settings)
    return "; ".join(faults)


def _losses(
    candidate: Validation, before: Validation, number: Gain, share: Gain, than: str, settings: ValidationSettings
) -> Iterator[str]:
    """What it loses: right matches, frames, or what was known of a recording of an earlier run."""
    judge = settings.matches
    if number.high < 0:
        yield f"fewer of its matches are right than {than}, by more than chance"
    if share.high < 0:
        yield f"a smaller share of its matches is right than {than}, by more than chance"
    if candidate.tracked < (1 - settings.frames_lost) * before.tracked:
        yield f"fewer frames are tracked than {than} ({before.tracked})"
    if candidate.segments > max(before.segments, 1) + settings.segments_more:  # none where nothing was tracked
        yield f"the odometry breaks more often than {than}"
    for one in before.earlier:
        if gain(candidate, before, loose(judge), judge, None, one).high < 0:
            yield f"in {one} a smaller share of its matches is right than {than}, by more than chance"


def _named(before: Validation, start: Validation) -> str:
    return "at the start" if before is start else "with the best round before"
