"""A second run over a segment whose verdict is a close call: do keypoints of another kind find the same path?

A verdict estimates the error of a path from the parts of its own evidence, good to a factor of about two. Near the
limit that decides nothing. Keypoints of another kind lie elsewhere, on other things, and go wrong in other places. So
where two runs find the same path it is right, and where both are believed but find two, one of them is wrong
(docs/log-odometry.md has the figures).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from improvo.errors import InputError
from improvo.frontend.registry import CLASSICAL
from improvo.frontend.settings import DEFAULT_FRONTEND
from improvo.geometry import se3
from improvo.jobs.interrupts import interrupts_wait
from improvo.odometry.gates import SAME_PATH, SAME_TURN_DEG
from improvo.odometry.mapping.initial_pair import NO_PARALLAX
from improvo.odometry.result.events import Event, told_verdict
from improvo.odometry.result.segments import Segment
from improvo.odometry.run.look_ahead import detected_ahead
from improvo.odometry.verdict.path_error import error_percent
from improvo.odometry.verdict.verdict import DOUBTFUL, RIGHT, Verdict
from improvo.odometry.visual_odometry import VisualOdometry
from improvo.types import Float64, Frame, Trajectory

_CLOSE = (0.6, 3.0)  # times the limit: an estimated error between them is a close call
_COVERED = 0.9  # of the segment's frames: what the second run must have with one scale
_TURN_SECONDS, _MOST_TURNS = 1.0, 0.95

FramesBetween = Callable[[int, int], Iterable[Frame]]


@dataclass(frozen=True)
class SecondPath:
    """What another run says of a segment.

    Attributes:
        frontend: name of the one that found its keypoints.
        difference_percent: of the positions after Sim3, % of the path; infinite where it has too few of the frames.
        difference_deg: of a turn over a second, or over the whole of a shorter segment; all but a twentieth are less.
        believed: whether its own verdict is that it is right.
        only_turns: whether it finds no path at all, since a camera that only turns explains what it sees.
    """

    frontend: str
    difference_percent: float
    difference_deg: float
    believed: bool
    only_turns: bool = False


def is_close_call(verdict: Verdict) -> bool:
    """Whether a verdict rests on nothing but an estimated error, and that is near the limit."""
    least, most = (factor * verdict.limit for factor in _CLOSE)
    return bool(np.isfinite(verdict.limit) and least <= verdict.error_percent <= most)


def other_kind(frontend: str) -> str:
    """Name of the frontend for a second run: SIFT after a network, the default network after a classical one."""
    return DEFAULT_FRONTEND if frontend in CLASSICAL else "sift"


def judged_again(verdict: Verdict, second: SecondPath, max_error: float) -> Verdict:
    """The verdict of a close call, with what a second run says; the same where that says nothing.

    Args:
        verdict: by the segment's own evidence.
        second: what the other run says.
        max_error: % of the path that a segment may be wrong by.
    """
    if second.only_turns:
        words = f"tracked again with {second.frontend}, a camera that only turns explains the motion"
        return replace(verdict, word=DOUBTFUL, evidence=(words, *verdict.evidence))
    difference, turns_alike = second.difference_percent, second.difference_deg <= SAME_TURN_DEG
    said = f"tracked again with {second.frontend}, the path"
    if turns_alike and difference <= SAME_PATH * max_error:
        word, words = RIGHT, f"{said} is the same to {difference:.1f} %"
    elif second.believed and not (turns_alike and difference <= max_error):
        word, words = DOUBTFUL, f"{said} differs by {difference:.1f} %, and either may be right"
    else:
        return verdict
    return replace(verdict, word=word, error_percent=difference, evidence=(words, *verdict.evidence))


def second_path(
    segment: Segment, trajectory: Trajectory, frames: Iterable[Frame], odometry: VisualOdometry, frontend: str
) -> SecondPath:
    """Track the frames of a segment again.

    Args:
        segment: of the first run.
        trajectory: of the first run, all of it.
        frames: `segment.first` to `segment.last`, each of them, in order.
        odometry: new, with a frontend of another kind.
        frontend: its name.

    Raises:
        InputError: a frame cannot be read any more.
    """
    with odometry:
        for detected in detected_ahead(frames, odometry.detect, odometry.match):
            with interrupts_wait():
                odometry.track_matched(detected.matched, detected.frame.time, detected.frame.image)
    again = odometry.trajectory
    rows = slice(segment.first, segment.first + len(again))
    own = trajectory.segment[rows] == segment.number
    numbers, counts = np.unique(again.segment[own & again.valid], return_counts=True)
    if len(numbers) == 0 or counts.max() < _COVERED * segment.frames:
        said = [event.detail for event in odometry.events if event.kind == "initialising"]
        only_turns = not again.valid.any() and bool(said) and all(words.startswith(NO_PARALLAX) for words in said)
        return SecondPath(frontend, float("inf"), float("inf"), False, only_turns)
    number = int(numbers[counts.argmax()])
    both = own & (again.segment == number)
    poses, poses_again = trajectory.world_from_cam[rows][both], again.world_from_cam[both]
    difference = error_percent(poses_again[:, :3, 3], poses[:, :3, 3])
    turns, turns_again = (_turns(trajectory.times[rows][both], each) for each in (poses, poses_again))
    apart = np.quantile(se3.rotation_angle_deg(np.swapaxes(turns, 1, 2) @ turns_again), _MOST_TURNS)
    believed = any(each.number == number and each.verdict.word == RIGHT for each in odometry.segments)
    return SecondPath(frontend, difference, float(apart), believed)


def _turns(times: Float64, world_from_cam: Float64) -> Float64:
    """(M, 3, 3) turns over a second, or over all frames (N,) where they are less."""
    later = np.searchsorted(times, times + _TURN_SECONDS)
    first = np.flatnonzero(later < len(times))
    begin, end = (first, later[first]) if len(first) else (np.array([0]), np.array([-1]))
    turns: Float64 = se3.inverse(world_from_cam[begin])[:, :3, :3] @ world_from_cam[end, :3, :3]
    return turns


def close_calls_tracked_again(
    segments: Sequence[Segment],
    trajectory: Trajectory,
    frames: FramesBetween,
    odometry: Callable[[], tuple[VisualOdometry, str]],
    max_error: float,
    note: Callable[[str], None],
) -> tuple[tuple[Segment, ...], tuple[Event, ...]]:
    """The segments of a run with their verdicts by two runs where the first left a close call, and what that changed.

    Args:
        segments: of the run.
        trajectory: of the run.
        frames: gives the frames from one index to another, both included.
        odometry: gives a new one with a frontend of another kind, and the name of that.
        max_error: % of the path that a segment may be wrong by.
        note: is told what is being done.
    """
    judged: list[Segment] = []
    events: list[Event] = []
    for segment in segments:
        judged.append(segment)
        if not is_close_call(segment.verdict):
            continue
        again, frontend = odometry()
        note(f"a close call: frames {segment.first} to {segment.last} again with {frontend}")
        try:
            second = second_path(segment, trajectory, frames(segment.first, segment.last), again, frontend)
        except InputError:  # a frame could be read a moment ago; the verdict stays
            continue
        judged[-1] = replace(segment, verdict=judged_again(segment.verdict, second, max_error))
        if judged[-1].verdict.word != segment.verdict.word:
            events.append(told_verdict(judged[-1], judged[-1].verdict.evidence[0]))
    return tuple(judged), tuple(events)
