"""One sequence from frames to files: what `improvo run` does."""

from __future__ import annotations

import re
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from improvo.errors import InputError
from improvo.files import make_output_folder, write_json
from improvo.frontend import Frontend
from improvo.frontend.registry import frontend_from, load_frontend
from improvo.geometry.trajectory_files import write_trajectory
from improvo.jobs.interrupts import interrupts_wait
from improvo.odometry.result.events import Event
from improvo.odometry.result.final_view import FinalView
from improvo.odometry.result.segments import Segment
from improvo.odometry.run.look_ahead import detected_ahead
from improvo.odometry.run.map_file import write_map
from improvo.odometry.run.point_colours import PointColours
from improvo.odometry.run.run_json import run_json, unit_of
from improvo.odometry.run.second_run import close_calls_tracked_again, other_kind
from improvo.odometry.run.track_recorder import TrackRecorder
from improvo.odometry.run_settings import RunSettings
from improvo.odometry.visual_odometry import TrackedFrame, VisualOdometry
from improvo.odometry.visualizer import NullVisualizer, Visualizer
from improvo.sequences import Sequence
from improvo.terminal import counted
from improvo.types import Frame, Trajectory

_ADDED = ("depth.zip", "dense.ply", "report.html")  # by later steps of some runs
_SHOWN = re.compile(r"(map|(tracks|residuals|labels)(_\d+)?)\.(png|gif|webp|mp4|webm)")  # by `improvo show`
_MIN_FRAMES = 3


@dataclass(frozen=True)
class RunSummary:
    """What a run found; `report` is the content of run.json."""

    folder: Path
    trajectory: Trajectory
    report: dict[str, Any]

    @property
    def unit(self) -> str:
        """Of lengths, for a person."""
        return unit_of(self.report)

    @property
    def tracked(self) -> int:
        """Frames with a pose."""
        return int(self.trajectory.valid.sum())


def run_odometry(
    sequence: Sequence,
    folder: Path,
    settings: RunSettings,
    command: str = "run",
    frontend: Frontend | None = None,
    visualizer: Visualizer | None = None,
    progress: Callable[[TrackedFrame], None] | None = None,
    complete: bool = True,
    note: Callable[[str], None] = lambda _: None,
) -> RunSummary:
    """Track a sequence and write its trajectory, map, tracks and report into `folder`.

    An interrupt (KeyboardInterrupt) ends the sequence there: what was tracked is written as a valid result. The result
    of an earlier run stays until the first file of this one is there. Then it is gone as a whole: without its run.json
    a folder is no result, and run.json comes last.

    Args:
        sequence: the frames.
        folder: made if need be; must be empty or one that `command` made.
        settings: all of them; `settings.sequence` is only recorded.
        command: that the folder belongs to.
        frontend: in place of the one that the settings name.
        visualizer: is shown every frame.
        progress: is called after every frame.
        complete: False leaves it to the caller to write run.json, after more files.
        note: is told what is done after the last frame.

    Raises:
        InputError: fewer than three readable frames.
        OutputError: the folder cannot be used.
    """
    frontend = frontend or frontend_from(settings.frontend)
    visualizer = visualizer or NullVisualizer()
    if sequence.length is not None and sequence.length < _MIN_FRAMES:
        raise InputError(
            f"{sequence.path}: has {counted(sequence.length, 'frame')}; odometry needs at least {_MIN_FRAMES}"
        )
    make_output_folder(folder, command)
    seconds: defaultdict[str, float] = defaultdict(float)
    started = time.perf_counter()
    colours = PointColours()
    with TrackRecorder(folder, sequence.camera, settings.labels) as recorder:

        def final(view: FinalView) -> None:
            recorder.add(view)
            colours.add(view)

        odometry = VisualOdometry(
            frontend,
            sequence.camera,
            settings.odometry,
            settings.frontend.use_stability,
            on_final=final,
            camera_is_guess=sequence.settings.camera_is_guess,
        )
        visualizer.begin(sequence.camera)
        try:
            processed, interrupted = _track_all(sequence, frontend, odometry, visualizer, progress, seconds)
            odometry.finish()
        finally:
            visualizer.end()
        if len(processed) < _MIN_FRAMES and not interrupted:
            raise InputError(f"{sequence.path}: only {len(processed)} of its frames can be read{_why_not(sequence)}")
        _remove_result(folder, settings)
    trajectory = odometry.trajectory
    write_trajectory(folder / "trajectory.txt", trajectory)
    sparse_map = odometry.map
    rgb = colours.read(sequence, processed, sparse_map.ids)
    write_map(folder / "map.ply", replace(sparse_map, rgb=rgb))
    segments, events = odometry.segments, odometry.events
    if settings.odometry.verdict.second_run and not interrupted and sequence.length is not None:
        begun = time.perf_counter()
        try:
            segments, told = _close_calls_tracked_again(sequence, settings, frontend, odometry, processed, note)
            events = (*events, *told)
        except KeyboardInterrupt:
            interrupted = True
        seconds["track again"] = time.perf_counter() - begun
    seconds["total"] = time.perf_counter() - started
    report = run_json(
        sequence, settings, frontend, odometry, processed, interrupted, recorder.counts, seconds, segments, events
    )
    if complete:
        write_json(folder / "run.json", report)
    return RunSummary(folder, trajectory, report)


def _remove_result(folder: Path, settings: RunSettings) -> None:
    """Take away what an earlier run left, and this one may not write again: first that it is a result."""
    names = ["run.json", *_ADDED]
    found, camera = folder / "camera.json", settings.sequence.camera
    if found.is_file() and (camera is None or Path(camera).absolute() != found.with_suffix(".yaml").absolute()):
        names += [found.name, "camera.yaml"]  # found for the earlier run, it would be taken for that of this one
    pictures = [path for path in (folder / "pictures").rglob("*") if _SHOWN.fullmatch(path.name)]
    for path in [*(folder / name for name in names), *pictures]:
        path.unlink(missing_ok=True)


def _why_not(sequence: Sequence) -> str:
    """What is wrong with the first frame that could not be read, and what to do."""
    if not sequence.skipped:
        return "; check the recording"
    first = sequence.skipped[0]
    return f" ({first.source} {first.reason}); give pictures that can all be read, of one size"


def _close_calls_tracked_again(
    sequence: Sequence,
    settings: RunSettings,
    frontend: Frontend,
    odometry: VisualOdometry,
    processed: list[int],
    note: Callable[[str], None],
) -> tuple[tuple[Segment, ...], tuple[Event, ...]]:
    """See `improvo.odometry.run.second_run`."""
    name = other_kind(frontend.name)

    def again() -> tuple[VisualOdometry, str]:
        other = load_frontend(name, settings.frontend.max_keypoints)
        guess = sequence.settings.camera_is_guess
        return VisualOdometry(other, sequence.camera, settings.odometry, camera_is_guess=guess), name

    def frames(first: int, last: int) -> Iterator[Frame]:
        for index in processed[first : last + 1]:
            yield sequence[int(np.searchsorted(sequence.indices, index))]

    max_error = settings.odometry.verdict.max_error
    return close_calls_tracked_again(odometry.segments, odometry.trajectory, frames, again, max_error, note)


def _track_all(
    sequence: Sequence,
    frontend: Frontend,
    odometry: VisualOdometry,
    visualizer: Visualizer,
    progress: Callable[[TrackedFrame], None] | None,
    seconds: defaultdict[str, float],
) -> tuple[list[int], bool]:
    """All frames in order; returns the recording's index of each processed one, and whether it was interrupted."""
    processed: list[int] = []
    try:
        for detected in detected_ahead(sequence, odometry.detect, odometry.match):
            with interrupts_wait():
                start = time.perf_counter()
                tracked = odometry.track_matched(detected.matched, detected.frame.time, detected.frame.image)
                seconds["track and adjust"] += time.perf_counter() - start
                seconds["read"] += detected.reading
                seconds["detect"] += detected.detecting
                seconds["match"] += detected.matching
                processed.append(detected.frame.source_index)
                view = odometry.newest_view
                assert view is not None
                visualizer.show(detected.frame, view, odometry.running_points)
                if progress is not None:
                    progress(tracked)
    except KeyboardInterrupt:
        return processed, True
    return processed, False
