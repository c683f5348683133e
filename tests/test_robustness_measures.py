"""What `benchmarks/robustness.py` calls a false alarm: the map was right when it was contradicted."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from simulated_features import CAMERA, hand_motion

from improvo.geometry import se3
from improvo.odometry.modes.states import TrackingState
from improvo.odometry.result.events import Event
from improvo.odometry.result.segments import Segment
from improvo.odometry.verdict.verdict import RIGHT, Verdict
from improvo.types import Float64, Trajectory

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
FRAMES, CUT = 90, 60
TRUTH = hand_motion(FRAMES, step=0.03)
TIMES = np.arange(FRAMES) / 30.0


@pytest.fixture
def measures(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import robustness_measures

    return robustness_measures


def scripted(running: Float64, final: Float64, event: Event, segments: list[Segment]) -> Any:
    """An odometry that has one map until an event at frame 80, and other poses at the end.

    Args:
        running: (N, 4, 4) world_from_cam of the map until then.
        final: (N, 4, 4) at the end; the second segment begins at `CUT`, if there is one.
        event: at frame 80.
        segments: at the end.
    """

    class Odometry:
        def __init__(self, *_: object) -> None:
            self.events: list[Event] = []
            self.segments: list[Segment] = segments
            self._tracked = 0

        @property
        def state(self) -> TrackingState:
            return TrackingState.TRACKING if self._tracked <= 80 else TrackingState.INITIALISING

        @property
        def trajectory(self) -> Trajectory:
            if not self.events:
                return Trajectory(TIMES[: self._tracked], running[: self._tracked], np.zeros(self._tracked, np.int64))
            return Trajectory(TIMES, final, (np.arange(FRAMES) >= CUT).astype(np.int64) * (len(segments) - 1))

        def track(self, frame: Any) -> None:
            self._tracked = frame.source_index + 1
            if frame.source_index == event.frame_index:
                self.events.append(event)

        def finish(self) -> None:
            pass

    return Odometry


def turned_late() -> Float64:
    """Right up to `CUT`; from there on, each frame turns by half a degree too much."""
    poses = TRUTH.copy()
    for i in range(CUT, FRAMES):
        extra = se3.rigid(se3.so3_exp(np.array([0.0, np.radians(0.5) * (i - CUT), 0.0])), np.zeros(3))
        poses[i] = TRUTH[i] @ extra
    return poses


@pytest.mark.parametrize("was_right", [True, False])
@pytest.mark.parametrize("ends", [True, False])
def test_an_alarm_is_judged_by_the_map_as_it_was_then(
    measures: ModuleType, monkeypatch: pytest.MonkeyPatch, *, was_right: bool, ends: bool
) -> None:
    """Its last frames are taken from a segment that ends, so what is left of it may be right though the map was not."""
    event = Event(
        80, "contradiction", f"something contradicts the map; {'the segment ends' if ends else 'started anew'}"
    )
    good = Verdict(RIGHT, 1.0, 0.3, limit=5.0)
    segments = [Segment(0, 0, FRAMES - 1, FRAMES, 0.5, "end of the sequence", good)]
    if ends:
        last = Segment(1, CUT, FRAMES - 1, FRAMES - CUT, 0.5, "end of the sequence", good)
        segments = [Segment(0, 0, CUT - 1, CUT, 0.5, "contradicted by something", good), last]
    odometry = scripted(TRUTH if was_right else turned_late(), TRUTH, event, segments)
    monkeypatch.setattr(measures, "VisualOdometry", odometry)
    clip = SimpleNamespace(
        times=TIMES, world_from_cam=TRUTH, images=[None] * FRAMES, camera=CAMERA, trackable=np.ones(FRAMES, bool)
    )
    judged = measures.run_and_judge(clip, None, 0)
    assert [segment.right for segment in judged.segments] == [True] * len(segments)
    assert [(alarm.frame, alarm.false) for alarm in judged.alarms] == [(80, was_right)]
