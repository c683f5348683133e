"""A recording becomes labels: the odometry records tracks, the paper's rule labels them, the quality gate withholds
some.

`improvo run` and `improvo label` both do it here, so that the same settings give the same `points.parquet`. The rule is
applied to each track while the odometry runs, as soon as the track has ended (`odometry/run/track_recorder.py`), so
that memory stays bounded. The gate comes at the end, and reads what was written a part at a time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from improvo.files import write_json
from improvo.labeling.quality import (
    FrameQuality,
    TrackFacts,
    assess_frames,
    doubtful_tracks,
    frame_medians,
    withhold_labels,
)
from improvo.odometry.run.run_odometry import RunSummary, run_odometry
from improvo.odometry.verdict.told_verdicts import doubtful_frames
from improvo.stability.settings import LabelSettings
from improvo.stability.tables import (
    POINTS_FILE,
    TRACKS_FILE,
    Observations,
    PointsTable,
    PointsWriter,
    read_observations,
    read_points,
    read_points_parts,
)

if TYPE_CHECKING:
    from pathlib import Path

    from improvo.frontend import Frontend
    from improvo.odometry.run_settings import RunSettings
    from improvo.odometry.visual_odometry import TrackedFrame
    from improvo.odometry.visualizer import Visualizer
    from improvo.sequences import Sequence


_FRAMES_AT_A_TIME = 1000


@dataclass(frozen=True)
class LabeledRun(RunSummary):
    """A run with its labels."""

    quality: FrameQuality

    @property
    def points(self) -> PointsTable:
        """What is in points.parquet."""
        return read_points(self.folder / POINTS_FILE)


def run_and_label(
    sequence: Sequence,
    folder: Path,
    settings: RunSettings,
    command: str = "run",
    frontend: Frontend | None = None,
    visualizer: Visualizer | None = None,
    progress: Callable[[TrackedFrame], None] | None = None,
    note: Callable[[str], None] = lambda _: None,
) -> LabeledRun:
    """Track a sequence, label its tracks, and write trajectory, map, tracks, labels and report into `folder`.

    Arguments, errors and interrupts as `run_odometry`.
    """
    summary = run_odometry(
        sequence, folder, settings, command, frontend, visualizer, progress, complete=False, note=note
    )
    return apply_quality_gate(summary, settings.labels)


def apply_quality_gate(run: RunSummary, settings: LabelSettings) -> LabeledRun:
    """Withhold the labels that are not to be trusted; `points.parquet` is written again, and at last `run.json`.

    Args:
        run: a finished run, whose `points.parquet` has the labels of the rule.
        settings: of the labels. With `settings.quality.enabled` off the frames are assessed and no label is withheld.
    """
    points_file, tracks_file, frames = run.folder / POINTS_FILE, run.folder / TRACKS_FILE, len(run.trajectory)
    facts = TrackFacts.of(read_points_parts(points_file), settings)
    error, parallax = np.full((2, frames), np.nan)
    for first in range(0, frames, _FRAMES_AT_A_TIME):
        some = range(first, min(first + _FRAMES_AT_A_TIME, frames))
        observations = Observations.joined(read_observations(tracks_file, some))
        error[some.start : some.stop], parallax[some.start : some.stop] = frame_medians(observations, facts, some)
    events = run.report["events"]
    alarms = np.array([event["frame_index"] for event in events if event["kind"] == "contradiction"], np.int64)
    segment = run.trajectory.segment
    in_doubt = doubtful_frames(run.report, segment)
    quality = assess_frames(error, parallax, run.trajectory.valid, alarms, settings, segment, in_doubt)
    counts: Counter[str] = Counter()
    if settings.quality.enabled:
        doubtful = doubtful_tracks(read_observations(tracks_file), facts, quality.trusted, settings)
        with PointsWriter(points_file) as writer:
            for part in read_points_parts(points_file):
                kept = withhold_labels(part, doubtful[facts.rows(part.track)])
                counts.update(kept.counts())
                writer.write(kept)
    else:
        for part in read_points_parts(points_file):
            counts.update(part.counts())
    report = {**run.report, "tracks": {**run.report["tracks"], **counts}, "quality": quality.counts()}
    write_json(run.folder / "run.json", report)
    return LabeledRun(run.folder, run.trajectory, report, quality)
