"""The states of the odometry, and every way from one to another.

    INITIALISING ── map_started ──► PROVISIONAL ── map_confirmed ──► TRACKING
         ▲                            │      ▲                       │      ▲
         │                       frame_lost  pose_found         frame_lost  pose_found
         │                            ▼      │                       ▼      │
         └──────── map_ended ◄────────────────────── LOST ──────────────────┘

`map_ended` leads back to INITIALISING from every other state: too many frames in a row are lost, or two-view geometry
contradicts the map. A provisional map that is contradicted is started anew over the same frames, and nothing of it was
final; one that was confirmed ends its segment. A provisional map may be joined with that of a segment that was lost
before (`mapping/bridging.py`), which changes its world and scale, but not the state.
"""

from __future__ import annotations

from enum import Enum


class TrackingState(Enum):
    """What the odometry is doing."""

    INITIALISING = "initialising"  # there is no map; frames are buffered until two of them can start one
    PROVISIONAL = "provisional"  # a map that may still be started anew
    TRACKING = "tracking"  # a map that nothing contradicted for long enough; what leaves its window is final
    LOST = "lost"  # the newest frame has no pose, but the map may be found again


class StateMachine:
    """The state of a mapper; a transition that the drawing above does not have raises."""

    def __init__(self) -> None:
        self.state = TrackingState.INITIALISING
        self._before_loss = TrackingState.INITIALISING

    @property
    def is_provisional(self) -> bool:
        """Whether there is a map that may still be started anew; also while it is lost."""
        known = self._before_loss if self.state is TrackingState.LOST else self.state
        return known is TrackingState.PROVISIONAL

    def map_started(self) -> None:
        """Two views started a map."""
        self._move(TrackingState.PROVISIONAL, TrackingState.INITIALISING)

    def map_confirmed(self) -> None:
        """Nothing contradicted the map for long enough."""
        self._move(TrackingState.TRACKING, TrackingState.PROVISIONAL)

    def frame_lost(self) -> None:
        """A frame has no pose."""
        if self.state is not TrackingState.LOST:
            self._before_loss = self.state
        self._move(TrackingState.LOST, TrackingState.PROVISIONAL, TrackingState.TRACKING, TrackingState.LOST)

    def pose_found(self) -> None:
        """A frame has a pose."""
        if self.state is TrackingState.LOST:
            self._move(self._before_loss, TrackingState.LOST)

    def map_ended(self) -> None:
        """There is no map any more."""
        self._move(TrackingState.INITIALISING, TrackingState.PROVISIONAL, TrackingState.TRACKING, TrackingState.LOST)

    def _move(self, to: TrackingState, *allowed: TrackingState) -> None:
        if self.state not in allowed:
            raise RuntimeError(f"the odometry cannot become {to.value} while it is {self.state.value}")
        self.state = to
