"""The states of mode `robust`, and the ways between them."""

from __future__ import annotations

import pytest

from improvo.odometry.modes.states import StateMachine, TrackingState


def machine(*steps: str) -> StateMachine:
    states = StateMachine()
    for step in steps:
        getattr(states, step)()
    return states


@pytest.mark.parametrize(
    ("steps", "state"),
    [
        ((), TrackingState.INITIALISING),
        (("map_started",), TrackingState.PROVISIONAL),
        (("map_started", "pose_found"), TrackingState.PROVISIONAL),
        (("map_started", "map_confirmed"), TrackingState.TRACKING),
        (("map_started", "frame_lost"), TrackingState.LOST),
        (("map_started", "frame_lost", "frame_lost", "pose_found"), TrackingState.PROVISIONAL),
        (("map_started", "map_confirmed", "frame_lost", "pose_found"), TrackingState.TRACKING),
        (("map_started", "frame_lost", "map_ended"), TrackingState.INITIALISING),
        (("map_started", "map_ended", "map_started"), TrackingState.PROVISIONAL),
    ],
)
def test_every_way(steps: tuple[str, ...], state: TrackingState) -> None:
    assert machine(*steps).state is state


def test_a_map_stays_provisional_while_it_is_lost() -> None:
    assert machine("map_started", "frame_lost").is_provisional
    assert not machine("map_started", "map_confirmed", "frame_lost").is_provisional
    assert not machine().is_provisional


@pytest.mark.parametrize(
    "steps",
    [
        ("frame_lost",),
        ("map_confirmed",),
        ("map_ended",),
        ("map_started", "map_started"),
        ("map_started", "map_confirmed", "map_confirmed"),
    ],
)
def test_there_is_no_other_way(steps: tuple[str, ...]) -> None:
    with pytest.raises(RuntimeError, match="cannot become"):
        machine(*steps)
