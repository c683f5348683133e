"""A recording becomes labels: the odometry records tracks, the paper's rule labels them, the quality gate withholds
some.

`improvo run` and `improvo label` both do it here, so that the same settings give the same `points.parquet`. The rule is
applied to each track while the odometry runs, as soon as the track has ended (`improvo.odometry.recorder`), so that
memory stays bounded. The gate needs the whole recording and comes at the end.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from improvo.files import write_json
from improvo.labeling.quality import FrameQuality, assess_frames, withhold_labels
from improvo.odometry.run import RunSummary, run_odometry
from improvo.odometry.told_verdicts import doubtful_frames
from improvo.stability.settings import LabelSettings
from improvo.stability.tables import POINTS_FILE, TRACKS_FILE, PointsTable, PointsWriter, read_points, read_tracks

if TYPE_CHECKING:
    from pathlib import Path

    from improvo.frontend import Frontend
    from improvo.odometry.run_settings import RunSettings
    from improvo.odometry.visual_odometry import TrackedFrame
    from improvo.odometry.visualizer import Visualizer
    from improvo.sequences import Sequence


@dataclass(frozen=True)
class LabeledRun(RunSummary):
    """A run with its labels."""

    points: PointsTable  # as in points.parquet
    quality: FrameQuality


def run_and_label(
    sequence: Sequence,
    folder: Path,
    settings: RunSettings,
    command: str = "run",
    frontend: Frontend | None = None,
    visualizer: Visualizer | None = None,
    progress: Callable[[TrackedFrame], None] | None = None,
) -> LabeledRun:
    """Track a sequence, label its tracks, and write trajectory, map, tracks, labels and report into `folder`.

    An interrupt (KeyboardInterrupt) ends the sequence there: what was tracked is written as a valid result.

    Args:
        sequence: the frames.
        folder: made if need be; must be empty or one that `command` made.
        settings: all of them; `settings.sequence` is only recorded.
        command: that the folder belongs to.
        frontend: in place of the one that the settings name.
        visualizer: is shown every frame.
        progress: is called after every frame.

    Raises:
        InputError: fewer than three readable frames.
        OutputError: the folder cannot be used.
    """
    summary = run_odometry(sequence, folder, settings, command, frontend, visualizer, progress)
    return apply_quality_gate(summary, settings.labels)


def apply_quality_gate(run: RunSummary, settings: LabelSettings) -> LabeledRun:
    """Withhold the labels that are not to be trusted; `points.parquet` and `run.json` are written again.

    Args:
        run: a finished run, whose `points.parquet` has the labels of the rule.
        settings: of the labels. With `settings.quality.enabled` off the frames are assessed and no label is withheld.
    """
    points, tracks = read_points(run.folder / POINTS_FILE), read_tracks(run.folder / TRACKS_FILE)
    alarms = [event["frame_index"] for event in run.report["events"] if event["kind"] == "contradiction"]
    trajectory = run.trajectory
    segment = trajectory.segment
    doubtful = doubtful_frames(run.report, segment)
    quality = assess_frames(tracks, points, trajectory.valid, np.array(alarms, np.int64), settings, segment, doubtful)
    if settings.quality.enabled:
        points = withhold_labels(points, tracks, quality.trusted, settings)
    with PointsWriter(run.folder / POINTS_FILE) as writer:
        writer.write(points)
    report = {**run.report, "tracks": {**run.report["tracks"], **points.counts()}, "quality": quality.counts()}
    write_json(run.folder / "run.json", report)
    return LabeledRun(run.folder, trajectory, report, points, quality)
