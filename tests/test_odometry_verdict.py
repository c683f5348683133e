"""The verdict: estimate, alarms, the lens, joined segments, and how run.json tells of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from simulated_features import CAMERA, hand_motion, room

from improvo.errors import ConfigError
from improvo.geometry import se3
from improvo.odometry.settings import VerdictSettings
from improvo.odometry.verdict.evidence import PARTS, Spread
from improvo.odometry.verdict.evidence_window import EvidenceKeyframe, EvidenceWindow
from improvo.odometry.verdict.lens_evidence import LensMeasure, measured_lens
from improvo.odometry.verdict.seen_again import SeenAgain
from improvo.odometry.verdict.told_verdicts import doubtful_frames, uncertain_frames, verdict_lines
from improvo.odometry.verdict.verdict import DOUBTFUL, NOT_JUDGED, RIGHT, Verdict, estimated_error, joined, judge
from improvo.types import Float64

SETTINGS = VerdictSettings()
GOOD = Spread(
    error_percent=np.full(len(PARTS), 0.3),
    scale_steps=np.full((2, len(PARTS)), 0.01),
    link_frames=np.array([[0, 20], [10, 30]]),
    leverage=np.full(2, 8.0),
    noise_px=0.3,
    width=640,
)


def changed(**changes: Any) -> Verdict:
    return judge(replace(GOOD, **changes), SETTINGS)


def test_a_good_spread_is_right_and_says_what_the_estimate_rests_on() -> None:
    verdict = judge(GOOD, SETTINGS)
    assert verdict.word == RIGHT
    assert verdict.error_percent == pytest.approx(1.15 * np.sqrt(6 * 0.3**2 + (6 * 8 * 0.01) ** 2))
    assert verdict.evidence[0].startswith("estimated error 1.0 % of the path: ")


def test_each_kind_of_evidence_can_make_a_segment_doubtful() -> None:
    quarter = changed(error_percent=np.array([5.5, 0.4, 0.3, 0.3, 0.2, 0.2]))
    assert quarter.word == DOUBTFUL
    assert "without the upper left quarter of the picture it differs by 5.5 %" in quarter.evidence[0]
    scale = changed(scale_steps=np.array([[0.01] * 6, [0.2] * 6]))
    assert scale.word == DOUBTFUL
    assert "the scale between frames 10 and 30 is known to 20 % only" in scale.evidence[0]
    assert scale.uncertain == ((10, 30),)
    assert changed(error_percent=np.full(6, 2.5)).word == DOUBTFUL
    alarmed = judge(GOOD, SETTINGS, ("two motions",))
    assert (alarmed.word, alarmed.evidence[0]) == (DOUBTFUL, "two motions")
    assert judge(GOOD, SETTINGS, (), ("two motions",)).word == RIGHT
    worse = replace(GOOD, error_percent=np.full(6, 1.5))
    assert (judge(worse, SETTINGS).word, judge(worse, SETTINGS, (), ("two motions",)).word) == (RIGHT, DOUBTFUL)
    assert judge(worse, SETTINGS, (), ("two maps were contradicted",), 2).word == DOUBTFUL
    slightly = replace(GOOD, error_percent=np.full(6, 1.0))
    words = [judge(slightly, SETTINGS, (), ("contradicted",), times).word for times in (1, 2)]
    assert words == [RIGHT, DOUBTFUL]
    told = judge(worse, SETTINGS, (), ("one map was contradicted",), 0)
    assert (told.word, told.evidence[1]) == (RIGHT, "although one map was contradicted")  # what speaks for it is first
    for share, words in ((0.004, "known to 0.4 %"), (0.06, "known to 6 %"), (0.2, "known to 20 % only")):
        steps = np.array([[0.0] * 6, [share] * 6])
        told = changed(error_percent=np.zeros(6), scale_steps=steps)
        assert told.evidence[0].endswith(words)
    assert judge(None, SETTINGS).word == NOT_JUDGED
    assert judge(None, SETTINGS, ("two motions",)).word == DOUBTFUL


def test_a_scale_counts_by_what_it_does_to_the_path_there() -> None:
    steps = np.array([[0.01] * 6, [0.15] * 6])
    middle, end = (changed(scale_steps=steps, leverage=np.array([8.0, each])) for each in (8.0, 0.5))
    assert (middle.word, end.word) == (DOUBTFUL, RIGHT)
    assert middle.uncertain == end.uncertain == ((10, 30),)  # told in both cases


def test_a_smaller_error_is_enough_where_the_scale_of_most_frames_is_not_determined() -> None:
    steps, leverage = np.array([[0.01] * 6, [0.15] * 6]), np.array([8.0, 0.5])
    for frames, word in (((0, 60), RIGHT), ((0, 40), DOUBTFUL)):  # 20 of 60 and of 40
        verdict = changed(error_percent=np.full(6, 1.5), scale_steps=steps, leverage=leverage, frames=frames)
        assert verdict.uncertain == ((10, 30),)
        assert verdict.word == word


def test_a_place_that_may_only_look_the_same_is_told() -> None:
    verdict = changed(leaps=(SeenAgain((12, 13), 90, 9),))
    assert verdict.evidence[-1].startswith(
        "frames 12 to 13: the place may only look like the one before, 9 of 90 points"
    )


def test_a_half_of_the_points_that_is_bad_by_chance_does_not_count_and_noise_does() -> None:
    unlucky = replace(GOOD, error_percent=np.array([0.3] * 5 + [9.0]))
    assert estimated_error(unlucky) == estimated_error(GOOD)
    noisy = replace(GOOD, noise_px=3.0 * 0.0016 * 640)
    assert estimated_error(noisy) == pytest.approx(27.0 * estimated_error(GOOD))
    assert "pixels off" in judge(noisy, SETTINGS).evidence[0]


def test_noise_is_averaged_over_the_keyframes_that_observe_a_point() -> None:
    usual = 0.0016 * 640
    noisy = replace(GOOD, noise_px=2.0 * usual)
    assert estimated_error(replace(noisy, views_per_point=4.0)) == estimated_error(noisy)
    assert estimated_error(replace(noisy, views_per_point=9.0)) == pytest.approx(
        (2.0 * 2 / 3) ** 3 * estimated_error(GOOD)
    )
    assert estimated_error(replace(noisy, views_per_point=100.0)) == estimated_error(GOOD)
    shared = replace(GOOD, shared_px=2.0 * 0.0007 * 640, views_per_point=9.0)
    assert estimated_error(shared) == pytest.approx((2.0 * 2 / 3) ** 3 * estimated_error(GOOD))


def test_a_lens_that_is_another_or_changes_is_an_alarm_where_it_is_known_well() -> None:
    same = LensMeasure((0, 40), 0.01, 0.01, 0.02, 0.01)
    assert changed(lens=(same, same)).word == RIGHT
    for other in (
        replace(same, offset=0.25),  # a wrong calibration
        replace(same, offset=0.15),  # another than in the first window
        replace(same, growth=-0.2),
    ):
        assert changed(lens=(same, other)).word == DOUBTFUL
        assert "the focal length" in changed(lens=(same, other)).evidence[0]
    unsure = replace(same, offset=0.25, offset_error=0.1, growth=0.3, growth_error=0.1)
    assert changed(lens=(same, unsure)).word == RIGHT


def test_one_window_of_hundreds_is_no_alarm_but_is_told() -> None:
    same = LensMeasure((0, 40), 0.01, 0.01, 0.02, 0.01)
    other = replace(same, growth=-0.2)
    assert changed(lens=(*[same] * 98, other)).word == DOUBTFUL
    verdict = changed(lens=(*[same] * 300, other))
    assert verdict.word == RIGHT
    assert "the focal length changes" in verdict.evidence[-1]
    assert changed(lens=(*[same] * 300, *[other] * 9)).word == DOUBTFUL


def window(growth: float, offset: float) -> EvidenceWindow:
    """Twelve keyframes in a room, through a lens whose focal length is not the camera's."""
    poses, xyz = se3.inverse(hand_motion(12, step=0.08, turn_deg=1.5)), room().points
    rng = np.random.default_rng(1)
    keyframes = []
    for i, pose in enumerate(poses):
        in_camera = se3.transform(pose, xyz)
        pixels = CAMERA.project(in_camera)
        inside = (pixels > 20).all(axis=1) & (pixels < (CAMERA.width - 20, CAMERA.height - 20)).all(axis=1)
        rows = np.flatnonzero((in_camera[:, 2] > 0.1) & inside)[:250]
        center: Float64 = CAMERA.K[:2, 2]
        factor = np.exp(offset + growth * (i / 11 - 0.5))
        seen = center + (pixels[rows] - center) * factor + rng.normal(scale=0.3, size=(len(rows), 2))
        keyframes.append(EvidenceKeyframe(i, pose, seen, rows, np.ones(len(rows))))
    return EvidenceWindow.of(keyframes, xyz)


@pytest.mark.parametrize("offset", [0.0, 0.1, -0.12])
def test_a_window_tells_its_focal_length(offset: float) -> None:
    found = measured_lens(window(0.0, offset), (0, 11), CAMERA)
    assert abs(found.offset - offset) < 0.04
    assert abs(found.growth) < 0.04
    assert 0.0 < found.offset_error < 0.02
    assert 0.0 < found.growth_error < 0.02


@pytest.mark.parametrize("growth", [0.12, -0.1])
def test_a_window_tells_that_its_focal_length_changes(growth: float) -> None:
    """How much is told too high: the poses that it starts from know nothing of the zoom."""
    found = measured_lens(window(growth, 0.0), (0, 11), CAMERA)
    assert 0.8 < found.growth / growth < 2.5
    assert found.growth_error < 0.02


def test_the_error_of_a_joined_stretch_counts_by_its_share_of_the_path() -> None:
    good, bad = judge(GOOD, SETTINGS), changed(error_percent=np.full(6, 3.0))
    assert (good.word, bad.word) == (RIGHT, DOUBTFUL)
    short = joined(good, bad, 0.01, (9.0, 1.0))
    assert short.word == RIGHT
    assert short.error_percent == pytest.approx(np.hypot(0.9 * good.error_percent, 0.1 * bad.error_percent))
    assert (
        short.evidence[-1] == f"joined, scale ±1 %: estimated error {short.error_percent:.1f} % of both paths together"
    )
    long = joined(bad, good, 0.01, (9.0, 1.0))
    assert (long.word, long.evidence[0]) == (DOUBTFUL, bad.evidence[0])
    assert long.error_percent == pytest.approx(np.hypot(0.9 * bad.error_percent, 0.1 * good.error_percent))
    twice = joined(short, good, 0.01, (10.0, 0.0))
    assert twice.error_percent == pytest.approx(short.error_percent)
    assert sum(words.startswith("joined") for words in twice.evidence) == 1


def test_joined_stretches_are_doubtful_by_their_scale_and_by_what_made_one_of_them_so() -> None:
    good, halves = judge(GOOD, SETTINGS), (1.0, 1.0)
    assert joined(good, good, 0.04, halves).error_percent == pytest.approx(2.0)
    assert joined(good, good, 0.11, halves).word == DOUBTFUL
    assert joined(good, Verdict(NOT_JUDGED), 0.01, halves) == good == joined(Verdict(NOT_JUDGED), good, 0.01, halves)
    zoomed = judge(GOOD, SETTINGS, ("the focal length changed",))
    unknown = judge(None, SETTINGS, ("two motions",))
    for alarmed in (zoomed, unknown):
        for both in (joined(good, alarmed, 0.01, (99.0, 1.0)), joined(alarmed, good, 0.01, (1.0, 99.0))):
            assert (both.word, both.evidence[0]) == (DOUBTFUL, alarmed.evidence[0])
            assert np.isfinite(both.error_percent)
            assert joined(both, good, 0.01, (1.0, 99.0)).word == DOUBTFUL
    suspected = judge(GOOD, SETTINGS, (), ("two motions",))
    larger = changed(error_percent=np.full(6, 1.5))
    assert (larger.word, suspected.word) == (RIGHT, RIGHT)
    assert joined(larger, suspected, 0.0, (99.0, 1.0)).word == DOUBTFUL  # over the smaller limit


def test_run_json_has_no_nan_and_tells_frames_and_lines() -> None:
    assert Verdict(NOT_JUDGED).report()["error_percent"] is None
    verdict = changed(error_percent=np.full(6, 3.0), scale_steps=np.full((2, 6), 0.15))
    segments = [
        {"number": 0, "first": 0, "last": 9, "verdict": judge(GOOD, SETTINGS).report()},
        {"number": 1, "first": 10, "last": 30, "verdict": verdict.report()},
        {"number": 2, "first": 31, "last": 33},  # of a run before there were verdicts
        {"number": 3, "first": 34, "last": 60, "frames": 20, "verdict": judge(GOOD, SETTINGS).report()},
        {"number": 4, "first": 36, "last": 70, "frames": 9, "verdict": judge(GOOD, SETTINGS).report()},
    ]
    segment = np.array([0, 0, 1, 1, -1, 2])
    assert doubtful_frames({"segments": segments}, segment).tolist() == [False, False, True, True, False, False]
    assert uncertain_frames({"segments": segments}, np.array([5, 25, 31])).tolist() == [True, True, False]
    lines = verdict_lines({"segments": segments})
    assert [line.split(":")[0] for line in lines] == [
        "segment 0 (frames 0 to 9) is right",
        "segment 1 (frames 10 to 30) is doubtful",
        "segment 2 (frames 31 to 33) is not judged",
        "segment 3 (frames 34 to 60) is right",
        "segment 4 (9 of frames 36 to 70) is right",
    ]
    assert verdict_lines({"segments": segments}, only=DOUBTFUL) == lines[1:2]


def test_wrong_settings_are_refused() -> None:
    with pytest.raises(ConfigError):
        VerdictSettings(max_error=0.0)
