"""A camera that only turns, where how wide it is was a guess: told from one that moves, and named in the verdict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from simulated_features import CAMERA, hand_motion, room

from improvo.geometry import se3
from improvo.odometry.settings import OdometrySettings, VerdictSettings
from improvo.odometry.verdict.evidence import PARTS, EvidenceCheck, Spread
from improvo.odometry.verdict.evidence_window import EvidenceKeyframe, EvidenceWindow
from improvo.odometry.verdict.judging import SegmentJudge
from improvo.odometry.verdict.told_verdicts import what_doubt_means
from improvo.odometry.verdict.turning_camera import TurningCamera, turning_camera
from improvo.odometry.verdict.verdict import DOUBTFUL, RIGHT, judge
from improvo.odometry.view import View
from improvo.sequences import SequenceSettings
from improvo.types import Float64

GOOD = Spread(
    np.full(len(PARTS), 0.3), np.full((2, len(PARTS)), 0.01), np.array([[0, 20], [10, 30]]), np.full(2, 8.0), 0.3, 640
)
TURNED = TurningCamera(error_px=0.5, map_px=0.4, fov=25.0, moved=0.2)


def telephoto(frames: int = 12) -> tuple[Float64, Float64, list[Float64]]:
    """A pan of a lens three times as long as CAMERA says, and the map that CAMERA makes of it: a wall, passed by.

    Returns:
        cam_from_world (F, 4, 4) and xyz (N, 3) of the map, and pixels (N, 2) in each frame, with noise.
    """
    rng = np.random.default_rng(0)
    long = replace(CAMERA, fx=3 * CAMERA.fx, fy=3 * CAMERA.fy)
    corner = np.array([CAMERA.width, CAMERA.height])
    rays = np.column_stack(
        [(rng.uniform(0.2, 0.8, (200, 2)) * corner - (CAMERA.cx, CAMERA.cy)) / long.fx, np.ones(200)]
    )
    xyz = rays * (3.0, 3.0, 1.0)
    poses, pixels = [], []
    for angle in np.linspace(0, 0.06, frames):
        turn = se3.so3_exp(np.array([0.0, -angle, 0.0]))
        pixels.append(long.project(rays @ turn.T) + rng.normal(0, 0.3, (200, 2)))
        poses.append(se3.rigid(np.eye(3), np.array([-3.0 * np.tan(angle), 0.0, 0.0])))
    return np.stack(poses), xyz, pixels


def window_of(cam_from_world: Float64, xyz: Float64, pixels: list[Float64]) -> EvidenceWindow:
    keyframes = []
    for frame, (pose, keypoints) in enumerate(zip(cam_from_world, pixels, strict=True)):
        seen = np.flatnonzero(np.isfinite(keypoints).all(axis=1))
        keyframes.append(EvidenceKeyframe(frame, pose, keypoints[seen], seen, np.ones(len(seen))))
    return EvidenceWindow.of(keyframes, xyz)


def moving(frames: int = 12) -> tuple[Float64, Float64, list[Float64]]:
    """A walk through a room, as `telephoto`."""
    rng = np.random.default_rng(0)
    poses, xyz = se3.inverse(hand_motion(frames, step=0.08, turn_deg=0.8)), room(400).points
    pixels = []
    for pose in poses:
        in_camera = se3.transform(pose, xyz)
        keypoints = CAMERA.project(in_camera) + rng.normal(0, 0.3, (len(xyz), 2))
        inside = (keypoints > 0).all(axis=1) & (keypoints < (CAMERA.width, CAMERA.height)).all(axis=1)
        keypoints[~(inside & (in_camera[:, 2] > 0.1))] = np.nan
        pixels.append(keypoints)
    return poses, xyz, pixels


def test_a_pan_of_a_longer_lens_is_explained_with_its_field_of_view() -> None:
    found = turning_camera(window_of(*telephoto()), CAMERA)
    assert found is not None
    assert found.error_px == pytest.approx(0.35, abs=0.1)
    assert found.error_px < 1.3 * found.map_px
    assert found.fov == pytest.approx(np.degrees(2 * np.arctan(CAMERA.width / (6 * CAMERA.fx))), rel=0.15)
    assert found.moved == pytest.approx(0.06 * 3 * CAMERA.fx / CAMERA.width, rel=0.1)


def test_no_focal_length_makes_a_turn_of_a_walk() -> None:
    found = turning_camera(window_of(*moving()), CAMERA)
    assert found is not None
    assert found.error_px > 5 * found.map_px
    poses, xyz, pixels = moving()
    few = [np.where(np.arange(len(xyz))[:, None] < 20, keypoints, np.nan) for keypoints in pixels]
    assert turning_camera(window_of(poses, xyz, few), CAMERA) is None


@pytest.mark.parametrize("guessed", [False, True])
def test_only_a_guessed_camera_is_asked_whether_it_turned(guessed: bool) -> None:
    poses, xyz, pixels = telephoto()
    segment = SegmentJudge(CAMERA, OdometrySettings(), guessed)
    check = EvidenceCheck(CAMERA, guessed)
    for frame, (pose, keypoints) in enumerate(zip(poses, pixels, strict=True)):
        rows = np.arange(len(xyz))
        few = np.zeros((len(xyz), 1), np.float32)
        view = View(frame, frame / 30, keypoints, few, np.ones(len(xyz)), rows, rows, keyframe=True)
        segment.final(view, pose, xyz)
        check.add(view, pose, xyz)
    spread = check.finish(xyz)
    assert spread is not None
    assert bool(spread.turning) == guessed
    told = segment.verdict(xyz).evidence
    assert any("a camera that only turns, " in words for words in told) == guessed


def test_the_verdict_names_a_camera_that_may_only_have_turned() -> None:
    def judged(*turning: TurningCamera) -> str:
        return judge(replace(GOOD, turning=turning), VerdictSettings()).word

    moved, still = replace(TURNED, error_px=2.0), replace(TURNED, moved=0.01)
    assert [judged(), judged(TURNED), judged(moved), judged(still)] == [RIGHT, DOUBTFUL, RIGHT, RIGHT]
    assert [judged(TURNED, moved), judged(TURNED, TURNED, moved), judged(TURNED, still)] == [RIGHT, DOUBTFUL, DOUBTFUL]
    verdict = judge(replace(GOOD, turning=(TURNED,)), VerdictSettings())
    assert verdict.evidence[0].startswith("a camera that only turns, 25 degrees wide, explains it as well")
    report = {"segments": [{"number": 0, "first": 0, "last": 9, "verdict": verdict.report()}]}
    assert any("improvo calibrate" in line for line in what_doubt_means(report))


def test_a_field_of_view_is_a_guess_and_a_calibration_is_none() -> None:
    assert SequenceSettings(fov=60.0).camera_is_guess
    assert not SequenceSettings().camera_is_guess
    assert not SequenceSettings(fov=60.0, camera="500,500,320,240").camera_is_guess
