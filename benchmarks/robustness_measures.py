"""How `benchmarks/robustness.py` judges a run: segment by segment and frame by frame, against the truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from improvo.errors import InputError
from improvo.evaluation.trajectory.protocol import align, clean_truth
from improvo.frontend import Frontend
from improvo.geometry.se3 import rotation_angle_deg
from improvo.odometry.gates import STEP_FRAMES
from improvo.odometry.modes.states import TrackingState
from improvo.odometry.result.events import Event
from improvo.odometry.result.segments import Segment
from improvo.odometry.run.second_run import close_calls_tracked_again
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.verdict.verdict import RIGHT as RIGHT_WORD
from improvo.odometry.visual_odometry import VisualOdometry
from improvo.types import Float64, Frame, Int64, Mask, Trajectory
from robustness_clips import Clip

RIGHT_PERCENT = 3.0  # of the segment's own path
WRONG_PERCENT = 5.0
RIGHT_ROTATION_DEG = 2.0  # over a second, or over a whole segment that is shorter
RIGHT_TURNS, WRONG_TURNS = 0.1, 0.5  # share of a segment's frames that turn otherwise, of a right and of a wrong one
MIN_FRAMES = 20  # of a segment, for it to count
MIN_PATH = 0.02  # metres; without a path, an error has no share of it
MIN_TRUE = 3  # frames of a segment with a true pose, for it to be compared
DOUBTS = ("focal length",)  # events that say that the segment may be wrong
# "Not judged" is neither a claim nor an alarm; a contradiction is one, of the segment as it was with the frames that
# are taken from it then.
_NO_DOUBTS = ("not judged", "contradicted")
RIGHT, WRONG, NONE, IMPOSSIBLE, POSE_OF_NOTHING, UNKNOWN = "R", "w", ".", "x", "X", "?"  # of a frame


@dataclass(frozen=True)
class JudgedSegment:
    """A segment of a finished run."""

    number: int
    first: int
    last: int
    frames: int
    true_frames: int  # of these have a true pose
    path_m: float  # true, over these
    error_percent: float | None  # ATE after Sim3 over the path; None where there is no path or no truth
    turned_wrong: float  # share of its frames whose turn over a second is wrong
    reason: str
    doubt: str  # what the run itself says against it; empty where it claims to be right
    estimated_error_percent: float | None  # by its verdict
    noise_px: float | None  # of its observations, by its verdict

    @property
    def counts(self) -> bool:
        """Whether it is long enough to count."""
        return self.frames >= MIN_FRAMES

    @property
    def known(self) -> bool:
        """Whether there is truth to compare it with."""
        return self.true_frames >= MIN_TRUE

    @property
    def near(self) -> bool:
        """Whether its positions are right."""
        return self.error_percent is not None and self.error_percent < RIGHT_PERCENT

    @property
    def right(self) -> bool:
        """Whether positions and rotations are right: with another lens, only the positions may be."""
        return self.near and self.turned_wrong <= RIGHT_TURNS

    @property
    def wrong(self) -> bool:
        """Whether its error is large, most of its turns are wrong, or it claims a path where there was none.

        Where the truth is missing, nothing is known against it.
        """
        if not self.known:
            return False
        return self.error_percent is None or self.error_percent > WRONG_PERCENT or self.turned_wrong > WRONG_TURNS

    @property
    def silent(self) -> bool:
        """Whether it is wrong and claims to be right."""
        return self.counts and self.wrong and not self.doubt


@dataclass(frozen=True)
class Alarm:
    """A segment that the odometry ended, started anew, or doubts."""

    frame: int
    detail: str
    error_percent: float | None  # of the segment then
    false: bool


@dataclass(frozen=True)
class Judged:
    """Everything about one run."""

    frames: str  # a letter for each: right, wrong, none, impossible, a pose of nothing, or of a segment without truth
    segments: list[JudgedSegment]
    alarms: list[Alarm]
    events: list[Event]

    @property
    def outcome(self) -> str:
        """`right`, `marked`, `lost` or `SILENT`."""
        if any(segment.silent for segment in self.segments) or self.frames.count(POSE_OF_NOTHING) > 2:
            return "SILENT"
        possible = sum(letter not in (IMPOSSIBLE, POSE_OF_NOTHING, UNKNOWN) for letter in self.frames)
        if self.frames.count(RIGHT) >= 0.8 * max(possible, 1):
            return "right"
        if self.alarms or any(segment.doubt for segment in self.segments):
            return "marked"
        return "lost"

    def as_json(self) -> dict[str, Any]:
        """For a file."""
        return {
            "outcome": self.outcome,
            "frames": self.frames,
            "segments": [
                {**asdict(each), "right": each.right, "wrong": each.wrong, "silent": each.silent, "counts": each.counts}
                for each in self.segments
            ],
            "alarms": [asdict(each) for each in self.alarms],
            "events": [asdict(each) for each in self.events],
        }


def run_and_judge(clip: Clip, frontend: Frontend, seed: int, other: Frontend | None = None) -> Judged:
    """Track a clip, and hold what the odometry says against the truth.

    Args:
        clip: pictures and truth.
        frontend: of the run.
        seed: of every RANSAC.
        other: of another kind, for a second run over close calls; None: there is none.
    """
    truth = clean_truth(Trajectory(clip.times, clip.world_from_cam))[0]
    odometry = VisualOdometry(frontend, clip.camera, OdometrySettings(seed=seed))
    contradictions = []
    before: Trajectory | None = None
    for number, (time, image) in enumerate(zip(clip.times.tolist(), clip.images, strict=True)):
        known = len(odometry.events)
        if odometry.state is not TrackingState.INITIALISING and number % STEP_FRAMES == 0:
            before = odometry.trajectory  # a check may start it anew, or take its last frames from it
        odometry.track(Frame(number, time, image, f"picture {number}"))
        for event in odometry.events[known:]:
            if event.kind == "contradiction" and before is not None:
                running = int(before.segment.max())
                error = _error_percent(before, truth, running)[1]
                turned = _share(_rotation_wrong(before, truth), before, running)
                right = error is not None and error < RIGHT_PERCENT and turned <= RIGHT_TURNS
                contradictions.append(Alarm(number, event.detail, error, right))
    odometry.finish()
    estimate = odometry.trajectory
    final: Sequence[Segment] = odometry.segments
    if other is not None:
        final = _tracked_again(clip, odometry, other, seed)
    rotation_wrong = _rotation_wrong(estimate, truth)
    segments = [_judged(segment, estimate, truth, rotation_wrong, odometry.events) for segment in final]
    alarms = contradictions + [
        Alarm(each.last, each.doubt, each.error_percent, each.right)
        for each in segments
        if each.doubt and not each.doubt.startswith(_NO_DOUBTS)
    ]
    return Judged(_frames(clip, estimate, rotation_wrong, segments), segments, alarms, list(odometry.events))


def _tracked_again(clip: Clip, odometry: VisualOdometry, other: Frontend, seed: int) -> Sequence[Segment]:
    """The segments as `improvo run` has them in the end."""
    settings = OdometrySettings(seed=seed)

    def frames(first: int, last: int) -> Iterator[Frame]:
        for number in range(first, last + 1):
            yield Frame(number, float(clip.times[number]), clip.images[number], f"picture {number}")

    return close_calls_tracked_again(
        odometry.segments,
        odometry.trajectory,
        frames,
        lambda: (VisualOdometry(other, clip.camera, settings), other.name),
        settings.verdict.max_error,
        lambda _: None,
    )[0]


def doubt(segment: Segment, events: Sequence[Event]) -> str:
    """What the run itself says against a segment; empty where it claims that it is right."""
    said = [each.detail for each in events if each.kind in DOUBTS and segment.first <= each.frame_index <= segment.last]
    if said:
        return said[0]
    if segment.reason.startswith("contradicted"):
        return segment.reason
    verdict = segment.verdict
    return "" if verdict.word == RIGHT_WORD else f"{verdict.word}: {'; '.join(verdict.evidence)}"


def _number(value: float) -> float | None:
    """JSON has no NaN."""
    return round(float(value), 4) if np.isfinite(value) else None


def _judged(
    segment: Segment, estimate: Trajectory, truth: Trajectory, rotation_wrong: Mask, events: Sequence[Event]
) -> JudgedSegment:
    path, error = _error_percent(estimate, truth, segment.number)
    return JudgedSegment(
        segment.number,
        segment.first,
        segment.last,
        segment.frames,
        len(_compared(estimate, truth, segment.number)),
        path,
        error,
        round(_share(rotation_wrong, estimate, segment.number), 3),
        segment.reason,
        doubt(segment, events),
        _number(segment.verdict.error_percent),
        _number(segment.verdict.noise_px),
    )


def _error_percent(estimate: Trajectory, truth: Trajectory, number: int) -> tuple[float, float | None]:
    """True path in metres, and the error after Sim3 in % of it."""
    rows = _compared(estimate, truth, number)
    centres = truth.camera_centers[rows]
    path = float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())
    if len(rows) < MIN_TRUE or path < MIN_PATH:
        return path, None
    try:
        motion = align(centres, estimate.camera_centers[rows], "sim3")
    except InputError:
        return path, None
    distance = np.linalg.norm(motion.apply(estimate.camera_centers[rows]) - centres, axis=1)
    return path, 100.0 * float(np.sqrt((distance**2).mean())) / path


def _compared(estimate: Trajectory, truth: Trajectory, number: int) -> Int64:
    """Rows of a segment that have a pose and a true one."""
    return np.flatnonzero(estimate.valid & truth.valid[: len(estimate)] & (estimate.segment == number))


def _share(rotation_wrong: Mask, estimate: Trajectory, number: int) -> float:
    """Of a segment's frames with a pose, those whose turn is wrong."""
    own = estimate.valid & (estimate.segment == number)
    return float(rotation_wrong[own].mean()) if own.any() else 0.0


def _frames(clip: Clip, estimate: Trajectory, rotation_wrong: Mask, segments: list[JudgedSegment]) -> str:
    """A letter for each frame."""
    right_segments = {segment.number for segment in segments if segment.near}
    unknown_segments = {segment.number for segment in segments if not segment.known}
    letters = []
    for row, has_pose in enumerate(estimate.valid.tolist()):
        if not clip.trackable[row]:
            letters.append(POSE_OF_NOTHING if has_pose else IMPOSSIBLE)
        elif not has_pose:
            letters.append(NONE)
        elif int(estimate.segment[row]) in unknown_segments:
            letters.append(UNKNOWN)
        else:
            right = int(estimate.segment[row]) in right_segments and not rotation_wrong[row]
            letters.append(RIGHT if right else WRONG)
    return "".join(letters)


def _rotation_wrong(estimate: Trajectory, truth: Trajectory) -> Mask:
    """(N,) frames whose turn within the second that begins with them, or ends, differs from the true one.

    A segment that is shorter than a second is judged by its turn from its first frame to its last.
    """
    wrong_from, wrong_to = np.zeros(len(estimate), bool), np.zeros(len(estimate), bool)
    judged_from, judged_to = wrong_from.copy(), wrong_to.copy()
    usable = np.flatnonzero(estimate.valid & truth.valid[: len(estimate)])
    times = estimate.times[usable]
    for row in usable.tolist():
        after = usable[np.argmin(np.abs(times - estimate.times[row] - 1.0))]
        if (
            estimate.segment[after] != estimate.segment[row]
            or abs(estimate.times[after] - estimate.times[row] - 1) > 0.2
        ):
            continue
        turn, true_turn = (_turn(each.world_from_cam, row, after) for each in (estimate, truth))
        wrong = bool(rotation_angle_deg((true_turn.T @ turn)[None])[0] > RIGHT_ROTATION_DEG)
        wrong_from[row], judged_from[row] = wrong, True
        wrong_to[after], judged_to[after] = wrong, True
    for number in np.unique(estimate.segment[usable]):
        own = usable[estimate.segment[usable] == number]
        if judged_from[own].any() or len(own) < 2:
            continue
        turn, true_turn = (_turn(each.world_from_cam, own[0], own[-1]) for each in (estimate, truth))
        wrong_from[own] = rotation_angle_deg((true_turn.T @ turn)[None])[0] > RIGHT_ROTATION_DEG
        judged_from[own] = True
    return (wrong_from | ~judged_from) & (wrong_to | ~judged_to) & (judged_from | judged_to)


def _turn(world_from_cam: Float64, first: int, last: int) -> Float64:
    turn: Float64 = world_from_cam[last, :3, :3].T @ world_from_cam[first, :3, :3]
    return turn
