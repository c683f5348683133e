"""A close call of a verdict is tracked again with keypoints of another kind, and both paths are compared."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rendered_walk import CAMERA, render

from improvo.frontend.registry import load_frontend
from improvo.odometry.run.run_odometry import run_odometry
from improvo.odometry.run.second_run import (
    SecondPath,
    close_calls_tracked_again,
    is_close_call,
    judged_again,
    other_kind,
    second_path,
)
from improvo.odometry.run_settings import FrontendSettings, RunSettings
from improvo.odometry.settings import OdometrySettings, VerdictSettings
from improvo.odometry.verdict.verdict import DOUBTFUL, RIGHT, Verdict
from improvo.odometry.visual_odometry import VisualOdometry
from improvo.sequences import Sequence, SequenceSettings, open_sequence
from improvo.simulation import bundled_sequence
from improvo.types import Frame, Trajectory

FRAMES = 60
SIFT = FrontendSettings(name="sift", max_keypoints=400)


@pytest.fixture(scope="module")
def room() -> Sequence:
    return open_sequence(bundled_sequence(), SequenceSettings(width=320, end=FRAMES))


@pytest.fixture(scope="module")
def first(room: Sequence) -> VisualOdometry:
    """A finished run with SIFT."""
    with VisualOdometry(load_frontend("sift", 400), room.camera) as odometry:
        for frame in room:
            odometry.track(frame)
    return odometry


def with_orb(room: Sequence) -> VisualOdometry:
    return VisualOdometry(load_frontend("orb", 600), room.camera)


def bent(trajectory: Trajectory) -> Trajectory:
    """The same, but its second half is three times as large: a jump of scale."""
    poses = trajectory.world_from_cam.copy()
    middle = len(poses) // 2
    poses[middle:, :3, 3] = poses[middle, :3, 3] + 3.0 * (poses[middle:, :3, 3] - poses[middle, :3, 3])
    return replace(trajectory, world_from_cam=poses)


@pytest.mark.parametrize(
    ("error", "limit", "close"),
    [(2.9, 5.0, False), (3.1, 5.0, True), (6.0, 5.0, True), (15.5, 5.0, False), (6.0, np.nan, False)],
)
def test_a_close_call_is_an_estimate_near_the_limit_and_no_alarm(error: float, limit: float, close: bool) -> None:
    assert is_close_call(Verdict(RIGHT, error, limit=limit)) is close


def test_a_verdict_that_nothing_was_measured_for_is_no_close_call() -> None:
    assert not is_close_call(Verdict(DOUBTFUL, float("nan"), limit=5.0))


def test_what_two_kinds_of_keypoints_agree_on_is_right() -> None:
    doubted = Verdict(DOUBTFUL, 6.6, evidence=("estimated error 6.6 %",), limit=5.0)
    believed = judged_again(doubted, SecondPath("sift", 1.1, 0.4, False), 5.0)
    assert (believed.word, believed.error_percent) == (RIGHT, 1.1)
    assert believed.evidence == ("tracked again with sift, the path is the same to 1.1 %", "estimated error 6.6 %")


@pytest.mark.parametrize("second", [SecondPath("sift", 8.0, 0.4, True), SecondPath("sift", 1.0, 9.0, True)])
def test_two_believed_paths_that_differ_make_a_doubt(second: SecondPath) -> None:
    assert judged_again(Verdict(RIGHT, 3.5, limit=5.0), second, 5.0).word == DOUBTFUL


@pytest.mark.parametrize(
    "second",
    [
        SecondPath("sift", 8.0, 0.4, False),  # wrong, and says so
        SecondPath("sift", 3.5, 0.4, True),  # neither the same nor another
        SecondPath("sift", float("inf"), float("inf"), False),  # lost
    ],
)
@pytest.mark.parametrize("word", [RIGHT, DOUBTFUL])
def test_a_second_run_that_says_nothing_changes_nothing(second: SecondPath, word: str) -> None:
    verdict = Verdict(word, 4.0, evidence=("estimated",), limit=5.0)
    assert judged_again(verdict, second, 5.0) == verdict


def test_a_second_run_to_which_the_camera_only_turns_makes_a_doubt(first: VisualOdometry) -> None:
    poses = np.tile(np.eye(4), (24, 1, 1))
    for number, angle in enumerate(np.linspace(0.0, 0.5, len(poses))):
        poses[number, :3, :3] = cv2.Rodrigues(np.array([0.0, angle, 0.0]))[0]
    rng = np.random.default_rng(0)
    textures = [rng.integers(0, 255, (64, 64), np.uint8).repeat(8, 0).repeat(8, 1) for _ in range(5)]
    frames = [Frame(number, number / 30, render(pose, textures), "turning") for number, pose in enumerate(poses)]
    odometry = VisualOdometry(load_frontend("sift", 400), CAMERA)
    second = second_path(replace(first.segments[0], last=23, frames=24), first.trajectory, frames, odometry, "sift")
    assert second == SecondPath("sift", float("inf"), float("inf"), False, only_turns=True)
    doubted = judged_again(Verdict(RIGHT, 3.4, limit=5.0), second, 5.0)
    assert (doubted.word, doubted.error_percent) == (DOUBTFUL, 3.4)
    assert doubted.evidence[0] == "tracked again with sift, a camera that only turns explains the motion"


def test_a_second_run_has_keypoints_of_another_kind() -> None:
    assert other_kind("superpoint-vo") == other_kind("better/weights.safetensors") == "sift"
    assert other_kind("sift") == other_kind("orb") == "superpoint-vo"


def test_another_frontend_finds_the_same_path_but_not_a_bent_one(room: Sequence, first: VisualOdometry) -> None:
    (segment,) = first.segments
    same = second_path(segment, first.trajectory, room, with_orb(room), "orb")
    assert same.difference_percent < 1.0
    assert same.difference_deg < 1.0
    assert same.believed
    other = second_path(segment, bent(first.trajectory), room, with_orb(room), "orb")
    assert other.difference_percent > 5.0
    assert other.difference_deg == pytest.approx(same.difference_deg)


def test_a_second_run_of_part_of_the_frames_says_nothing(room: Sequence, first: VisualOdometry) -> None:
    (segment,) = first.segments
    some = [room[number] for number in range(FRAMES // 2)]
    part = second_path(segment, first.trajectory, some, with_orb(room), "orb")
    assert part == SecondPath("orb", float("inf"), float("inf"), False)


def test_only_close_calls_are_tracked_again_and_the_change_is_told(room: Sequence, first: VisualOdometry) -> None:
    (segment,) = first.segments
    asked: list[tuple[int, int]] = []

    def frames(begin: int, end: int) -> Iterator[Frame]:
        asked.append((begin, end))
        return (room[number] for number in range(begin, end + 1))

    def tracked_again(verdict: Verdict) -> Any:
        changed = replace(segment, verdict=verdict)
        found: list[str] = []
        given = ([changed], first.trajectory, frames, lambda: (with_orb(room), "orb"), 5.0, found.append)
        return *close_calls_tracked_again(*given), found

    sure = Verdict(RIGHT, 1.0, limit=5.0)
    assert tracked_again(sure) == ((replace(segment, verdict=sure),), (), [])
    assert asked == []
    (judged,), (event,), notes = tracked_again(Verdict(DOUBTFUL, 7.0, limit=5.0))
    assert asked == [(0, FRAMES - 1)]
    assert judged.verdict.word == RIGHT
    assert (event.frame_index, event.kind) == (FRAMES - 1, "withdrawn")
    assert event.detail.startswith("segment 0 is believed: tracked again with orb")
    assert notes == [f"a close call: frames 0 to {FRAMES - 1} again with orb"]


def verdict_of(folder: Path) -> tuple[dict[str, Any], dict[str, float]]:
    report = json.loads((folder / "run.json").read_text())
    return report["segments"][0]["verdict"], report["seconds"]


def test_a_run_says_that_it_tracked_a_close_call_again(room: Sequence, tmp_path: Path) -> None:
    settings = RunSettings(frontend=SIFT)
    run_odometry(room, tmp_path / "sure", settings)
    sure, seconds = verdict_of(tmp_path / "sure")
    assert sure["word"] == RIGHT
    assert seconds["track again"] < 0.1
    near = OdometrySettings(verdict=VerdictSettings(max_error=1.2 * sure["error_percent"]))
    run_odometry(room, tmp_path / "near", replace(settings, odometry=near))
    again, seconds = verdict_of(tmp_path / "near")
    assert again["word"] == RIGHT
    assert again["evidence"][0].startswith("tracked again with superpoint-vo, the path is the same to ")
    assert again["error_percent"] < sure["error_percent"]
    assert seconds["track again"] > 0.1
    once = replace(near, verdict=replace(near.verdict, second_run=False))
    run_odometry(room, tmp_path / "once", replace(settings, odometry=once))
    assert verdict_of(tmp_path / "once")[0] == sure
