"""The quality gate: which frames are trusted, and which labels are withheld."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from improvo.labeling import quality as gate
from improvo.labeling.quality import FrameQuality, TrackFacts
from improvo.stability.rule import IGNORE, STABLE, UNSTABLE
from improvo.stability.settings import LabelQualitySettings, LabelSettings
from improvo.stability.tables import Observations, PointsTable, read_observations, tracks_schema

FRAMES = 60


def tables(error: np.ndarray, parallax: np.ndarray) -> tuple[Observations, PointsTable]:
    """Four tracks of 15 frames after each other, ten times; error by frame, parallax by track group."""
    count = 40
    track = np.repeat(np.arange(count) * 5, 15)
    frame = np.concatenate([np.arange(15) + 15 * (t % 4) for t in range(count)])
    tracks = Observations(frame, track, error[frame].astype(np.float32))
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


def assess_frames(
    tracks: Observations, points: PointsTable, has_pose: np.ndarray, alarms: np.ndarray, rule: LabelSettings, *more: Any
) -> FrameQuality:
    """All frames at once."""
    medians = gate.frame_medians(tracks, TrackFacts.of([points], rule), range(len(has_pose)))
    return gate.assess_frames(*medians, has_pose, alarms, rule, *more)


def withhold_labels(points: PointsTable, tracks: Observations, trusted: np.ndarray, rule: LabelSettings) -> PointsTable:
    """All tracks at once."""
    facts = TrackFacts.of([points], rule)
    return gate.withhold_labels(points, gate.doubtful_tracks([tracks], facts, trusted, rule)[facts.rows(points.track)])


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
    joined = np.where(np.arange(FRAMES) < 10, 1, np.where(np.arange(FRAMES) < 25, -1, 1))  # lost, and found again
    again = assess_frames(tracks, points, has_pose, np.array([40]), LabelSettings(), joined)
    assert np.flatnonzero(again.contradicted).tolist() == list(range(22, 41))
    other = np.where(np.arange(FRAMES) < 10, 1, np.where(np.arange(FRAMES) < 15, 0, 1))  # another map lies between
    again = assess_frames(tracks, points, has_pose, np.array([40]), LabelSettings(), other)
    assert np.flatnonzero(again.contradicted).tolist() == list(range(15, 41))
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
    none = Observations(*(getattr(tracks, name)[:0] for name in Observations.__dataclass_fields__))
    empty = PointsTable(*(getattr(points, name)[:0] for name in PointsTable.__dataclass_fields__))
    quality = assess_frames(none, empty, np.zeros(FRAMES, bool), np.zeros(0, int), LabelSettings())
    assert not quality.trusted.any()
    assert len(withhold_labels(empty, none, quality.trusted, LabelSettings())) == 0


def test_parts_are_assessed_like_the_whole(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    tracks, points = tables(rng.uniform(0.2, 3.0, FRAMES), rng.uniform(0.2, 2.0, 4))
    tracks.error[rng.uniform(size=len(tracks.error)) < 0.1] = np.nan
    rule = LabelSettings()
    file = tmp_path / "tracks.parquet"
    with pq.ParquetWriter(file, tracks_schema()) as writer:  # small groups, tracks in any order
        for group in np.array_split(rng.permutation(40) * 5, 7):
            rows = np.isin(tracks.track, group)
            zeros = np.zeros(rows.sum(), np.float32)
            columns = [tracks.frame[rows].astype(np.int32), tracks.track[rows], zeros, zeros, zeros, tracks.error[rows]]
            writer.write_table(pa.table(columns, tracks_schema()))
    facts = TrackFacts.of([points], rule)
    whole = gate.frame_medians(tracks, facts, range(FRAMES))
    some = [range(13), range(13, 14), range(14, FRAMES)]
    parts = [gate.frame_medians(Observations.joined(read_observations(file, part)), facts, part) for part in some]
    for found, expected in zip(zip(*parts, strict=True), whole, strict=True):
        np.testing.assert_array_equal(np.concatenate(found), expected)
    trusted = rng.uniform(size=FRAMES) < 0.6
    doubtful = gate.doubtful_tracks(read_observations(file), facts, trusted, rule)
    np.testing.assert_array_equal(doubtful, gate.doubtful_tracks([tracks], facts, trusted, rule))
    assert 0 < doubtful.sum() < 40
    late = [len(part.frame) for part in read_observations(file, range(50, FRAMES))]
    assert sum(late) == (tracks.frame >= 50).sum()


def test_frames_of_a_segment_that_the_odometry_doubts_are_not_trusted() -> None:
    nothing = np.full(FRAMES, np.nan)
    has_pose, doubtful = np.ones(FRAMES, bool), np.arange(FRAMES) >= 30
    quality = gate.assess_frames(nothing, nothing, has_pose, np.zeros(0, int), LabelSettings(), None, doubtful)
    assert np.flatnonzero(~quality.trusted).tolist() == list(range(30, FRAMES))
    assert quality.counts()["doubtful"] == FRAMES - 30
