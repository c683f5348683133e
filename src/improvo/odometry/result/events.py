"""What the user should know about single frames: where tracking failed, and where the map was doubted."""

from __future__ import annotations

from dataclasses import dataclass

from improvo.odometry.mapping.bridging import Join
from improvo.odometry.result.segments import Segment
from improvo.odometry.verdict.verdict import DOUBTFUL, NOT_JUDGED, RIGHT, Verdict

_WORTH_SAYING = 0.03  # share of the keypoints
_SAID_AGAIN = 20  # frames


@dataclass(frozen=True)
class Event:
    """Something the user should know about a frame."""

    frame_index: int
    # "initialising", "segment", "lost", "contradiction", "checked again", "bridged", "uncertain", "doubtful",
    # "withdrawn", "attached", "two motions" or "focal length"
    kind: str
    detail: str


def told_verdict(segment: Segment, why: str) -> Event:
    """That a segment is doubtful, or that it is believed after a doubt."""
    if segment.verdict.word == RIGHT:
        return Event(segment.last, "withdrawn", f"segment {segment.number} is believed: {why}")
    return Event(segment.last, "doubtful", f"segment {segment.number}: {why}")


class EventLog:
    """Collects the events of a run in order."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self._last_failure = ""
        self._attached_said = 0.0
        self._two_motions_said = -_SAID_AGAIN - 1
        self._verdicts: dict[int, Verdict] = {}  # by segment, as told

    def segment_started(self, frame_index: int, number: int) -> None:
        """A map has started; the first segment is not worth an event."""
        if number > 0:
            self._add(frame_index, "segment", f"segment {number} starts: own scale, placed by guess")
        self._last_failure = ""

    def initialisation_failed(self, frame_index: int, reason: str) -> None:
        """No map could start yet; the same reason is said once in a row."""
        if reason != self._last_failure:
            self._add(frame_index, "initialising", reason)
            self._last_failure = reason

    def lost(self, frame_index: int, inliers: int, refused: int = 0) -> None:
        """A frame has no pose: only `inliers` map points were found in it, or `refused` ones at an impossible place."""
        elsewhere = (
            f"{refused} points of the map found, but where the camera can hardly have come to: another place looks "
            "alike, or frames are missing before it"
        )
        self._add(frame_index, "lost", elsewhere if refused else f"only {inliers} points of the map found")

    def contradicted(self, frame_index: int, consequence: str, by: str = "two-view geometry") -> None:
        """Something says that the map is wrong."""
        self._add(frame_index, "contradiction", f"{by} contradicts the map; {consequence}")

    def checked_again(self, frame_index: int, by: str, found: str) -> None:
        """Something spoke against the map, and a map started anew over the same frames did not."""
        self._add(frame_index, "checked again", f"{by} spoke against the map; a map started anew {found}")

    def focal_length(self, frame_index: int, factor: float, consequence: str) -> None:
        """The lens is not what the camera says."""
        said = f"the focal length is about {factor:.2f} times that of the camera as given"
        self._add(frame_index, "focal length", f"{said}; {consequence}")

    def two_motions(self, frame_index: int) -> None:
        """Two motions are in the picture, and one of them is not the camera's; said once in a while."""
        if frame_index - self._two_motions_said > _SAID_AGAIN:
            self._add(frame_index, "two motions", "another motion beside the map's; one of both is not the camera's")
            self._two_motions_said = frame_index

    def attached(self, frame_index: int, share: float) -> None:
        """A share of the keypoints moves with the camera; said again only where it is much larger than before."""
        if share > max(_WORTH_SAYING, 1.5 * self._attached_said):
            self._attached_said = share
            said = f"{share:.0%} of the keypoints stand in the picture while the rest moves; they make no map"
            self._add(frame_index, "attached", said)

    def bridged(self, frame_index: int, join: Join) -> None:
        """The running map lies in the world of a segment that ended before."""
        scale = f"scale ±{100 * join.scale_error:.1g} %"
        self._add(
            frame_index, "bridged", f"joined with segment {join.number}: {join.points} of its points found, {scale}"
        )

    def judged(self, segment: Segment) -> None:
        """A segment has ended; what a user should know of its verdict, and was not told before, is an event.

        Args:
            segment: with all stretches that were joined with it; it ends with each of them.
        """
        before = self._verdicts.get(segment.number, Verdict(NOT_JUDGED))
        self._verdicts[segment.number] = segment.verdict
        for first, last in segment.verdict.uncertain:
            if (first, last) not in before.uncertain:
                self._add(first, "uncertain", f"the scale is not determined between frames {first} and {last}")
        if segment.verdict.word == RIGHT and before.word == DOUBTFUL:
            self.events.append(told_verdict(segment, segment.verdict.evidence[-1]))
        if segment.verdict.word == DOUBTFUL != before.word:
            self.events.append(told_verdict(segment, segment.verdict.evidence[0]))

    def _add(self, frame_index: int, kind: str, detail: str) -> None:
        self.events.append(Event(frame_index, kind, detail))
