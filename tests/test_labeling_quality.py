"""The quality gate: which frames are trusted, and which labels are withheld."""

from __future__ import annotations

import numpy as np

from improvo.labeling.quality import assess_frames, withhold_labels
from improvo.stability.rule import IGNORE, STABLE, UNSTABLE
from improvo.stability.settings import LabelQualitySettings, LabelSettings
from improvo.stability.tables import PointsTable, TracksTable

FRAMES = 60


def tables(error: np.ndarray, parallax: np.ndarray) -> tuple[TracksTable, PointsTable]:
    """Four tracks of 15 frames after each other, ten times; error by frame, parallax by track group."""
    count = 40
    track = np.repeat(np.arange(count) * 5, 15)
    frame = np.concatenate([np.arange(15) + 15 * (t % 4) for t in range(count)])
    tracks = TracksTable(
        frame=frame,
        track=track,
        keypoints=np.zeros((len(track), 2), np.float32),
        weight=np.ones(len(track), np.float32),
        error=error[frame].astype(np.float32),
    )
    order = np.random.default_rng(0).permutation(count)  # rows of the tables need not be in the same order
    points = PointsTable(
        track=(np.arange(count) * 5)[order],
        point=np.full(count, -1),
        xyz=np.zeros((count, 3)),
        observations=np.full(count, 15),
        mean_error=np.zeros(count, np.float32),
        max_error=np.zeros(count, np.float32),
        stability=np.array([STABLE, STABLE, UNSTABLE, IGNORE], np.int8)[(np.arange(count) // 4 % 4)[order]],
        segment=np.zeros(count, np.int64),
        parallax_deg=parallax[(np.arange(count) % 4)[order]].astype(np.float32),
        withheld=np.zeros(count, np.bool_),
    )
    return tracks, points


def test_a_good_run_is_trusted_everywhere():
    tracks, points = tables(np.full(FRAMES, 0.5), np.full(4, 3.0))
    quality = assess_frames(tracks, points, np.ones(FRAMES, bool), np.zeros(0, int), LabelSettings())
    assert quality.trusted.all()
    assert quality.counts()["not_trusted"] == 0
    after = withhold_labels(points, tracks, quality.trusted, LabelSettings())
    np.testing.assert_array_equal(after.stability, points.stability)
    assert not after.withheld.any()


def test_each_reason_is_found_where_it_is():
    error = np.where(np.arange(FRAMES) < 15, 4.0, 0.5)
    has_pose = np.arange(FRAMES) < 55
    tracks, points = tables(error, np.array([3.0, 0.1, 3.0, 3.0]))
    quality = assess_frames(tracks, points, has_pose, np.array([40]), LabelSettings())
    assert np.flatnonzero(quality.high_error).tolist() == list(range(15))
    assert np.flatnonzero(quality.little_parallax).tolist() == list(range(15, 30))
    assert np.flatnonzero(quality.contradicted).tolist() == list(range(22, 41))
    segment = np.where(np.arange(FRAMES) < 10, 0, 1)  # the map of 10 to 40 was contradicted, and started anew
    again = assess_frames(tracks, points, has_pose, np.array([40]), LabelSettings(), segment)
    assert np.flatnonzero(again.contradicted).tolist() == list(range(10, 41))
    lost = np.where(np.arange(FRAMES) == 40, -1, segment)
    assert assess_frames(tracks, points, has_pose, np.array([40]), LabelSettings(), lost).contradicted.sum() == 19
    assert np.flatnonzero(quality.no_pose).tolist() == list(range(55, 60))
    assert np.flatnonzero(quality.trusted).tolist() == list(range(41, 55))


def test_short_tracks_do_not_speak_against_a_frame():
    tracks, points = tables(np.full(FRAMES, 9.0), np.full(4, 3.0))
    rule = LabelSettings(min_observations=16)
    assert assess_frames(tracks, points, np.ones(FRAMES, bool), np.zeros(0, int), rule).trusted.all()


def test_labels_are_withheld_from_tracks_that_live_mostly_in_frames_that_are_not_trusted():
    tracks, points = tables(np.full(FRAMES, 0.5), np.full(4, 3.0))
    trusted = np.arange(FRAMES) >= 23  # all of frames 0-14, and 8 of the 15 of the next tracks
    after = withhold_labels(points, tracks, trusted, LabelSettings())
    group = points.track // 5 % 4
    labelled = points.stability != IGNORE
    np.testing.assert_array_equal(after.withheld, labelled & (group <= 1))
    assert (after.stability[after.withheld] == IGNORE).all()
    np.testing.assert_array_equal(after.stability[~after.withheld], points.stability[~after.withheld])
    counts = after.counts()
    assert counts["withheld"] == after.withheld.sum() > 0
    gentle = LabelSettings(quality=LabelQualitySettings(min_trusted_share=0.4))
    assert withhold_labels(points, tracks, trusted, gentle).withheld.sum() < counts["withheld"]


def test_no_tracks_at_all():
    tracks, points = tables(np.full(FRAMES, 0.5), np.full(4, 3.0))
    none = TracksTable(*(getattr(tracks, name)[:0] for name in TracksTable.__dataclass_fields__))
    empty = PointsTable(*(getattr(points, name)[:0] for name in PointsTable.__dataclass_fields__))
    quality = assess_frames(none, empty, np.zeros(FRAMES, bool), np.zeros(0, int), LabelSettings())
    assert not quality.trusted.any()
    assert len(withhold_labels(empty, none, quality.trusted, LabelSettings())) == 0
