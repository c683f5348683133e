"""What the user should know about single frames: where tracking failed, and where the map was doubted."""

from __future__ import annotations

from dataclasses import dataclass

_WORTH_SAYING = 0.03  # share of the keypoints


@dataclass(frozen=True)
class Event:
    """Something the user should know about a frame."""

    frame_index: int
    kind: str  # "initialising", "segment", "lost", "contradiction" or "attached"
    detail: str


class EventLog:
    """Collects the events of a run in order."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self._last_failure = ""
        self._attached_said = 0.0

    def segment_started(self, frame_index: int, number: int) -> None:
        """A map has started; the first segment is not worth an event."""
        if number > 0:
            self._add(frame_index, "segment", f"segment {number + 1} starts: own scale, placed by guess")
        self._last_failure = ""

    def initialisation_failed(self, frame_index: int, reason: str) -> None:
        """No map could start yet; the same reason is said once in a row."""
        if reason != self._last_failure:
            self._add(frame_index, "initialising", reason)
            self._last_failure = reason

    def lost(self, frame_index: int, inliers: int) -> None:
        """A frame has no pose, because only `inliers` map points were found in it."""
        self._add(frame_index, "lost", f"only {inliers} points of the map found")

    def contradicted(self, frame_index: int, consequence: str, by: str = "two-view geometry") -> None:
        """Something says that the map is wrong."""
        self._add(frame_index, "contradiction", f"{by} contradicts the map; {consequence}")

    def attached(self, frame_index: int, share: float) -> None:
        """A share of the keypoints moves with the camera; said again only where it is much larger than before."""
        if share > max(_WORTH_SAYING, 1.5 * self._attached_said):
            self._attached_said = share
            said = f"{share:.0%} of the keypoints stand in the picture while the rest moves; they make no map"
            self._add(frame_index, "attached", said)

    def _add(self, frame_index: int, kind: str, detail: str) -> None:
        self.events.append(Event(frame_index, kind, detail))
