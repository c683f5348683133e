"""One sequence from frames to files: what `improvo run` does."""

from __future__ import annotations

import platform
import re
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from improvo import __version__
from improvo.config import to_dict
from improvo.errors import InputError
from improvo.files import make_output_folder, write_json
from improvo.formats import FORMAT, FORMAT_KEY
from improvo.frontend import Frontend
from improvo.frontend.registry import frontend_from
from improvo.geometry.ransac import robust_solver
from improvo.geometry.trajectory_files import write_trajectory
from improvo.jobs.interrupts import interrupts_wait
from improvo.odometry.ahead import detected_ahead
from improvo.odometry.map_file import write_map
from improvo.odometry.point_colours import PointColours
from improvo.odometry.recorder import TrackRecorder
from improvo.odometry.run_settings import RunSettings
from improvo.odometry.view import FinalView
from improvo.odometry.visual_odometry import TrackedFrame, VisualOdometry
from improvo.odometry.visualizer import NullVisualizer, Visualizer
from improvo.sequences import Sequence
from improvo.sequences.given_files import with_absolute_files
from improvo.terminal import counted
from improvo.types import Trajectory

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


def unit_of(report: dict[str, Any]) -> str:
    """The unit of a run's lengths, in words, by its run.json: metres and from what they are known, or up to scale."""
    return str(report["scale"]) if report.get("metric") else "up to scale"


def metres_per_unit(report: dict[str, Any], segment: int) -> float:
    """Metres per unit of the odometry in a segment of a run, by its run.json; 1 where the run is up to scale."""
    known = {each["segment"]: each["metres_per_unit"] for each in (report.get("metric") or {}).get("segments", [])}
    before = [number for number in sorted(known) if number <= segment] or sorted(known)[:1]
    return float(known[before[-1]]) if before else 1.0


def run_odometry(
    sequence: Sequence,
    folder: Path,
    settings: RunSettings,
    command: str = "run",
    frontend: Frontend | None = None,
    visualizer: Visualizer | None = None,
    progress: Callable[[TrackedFrame], None] | None = None,
    complete: bool = True,
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
    seconds["total"] = time.perf_counter() - started
    report = _report(sequence, settings, frontend, odometry, processed, interrupted, recorder.counts, seconds)
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


def _report(
    sequence: Sequence,
    settings: RunSettings,
    frontend: Frontend,
    odometry: VisualOdometry,
    processed: list[int],
    interrupted: bool,
    tracks: Counter[str],
    seconds: defaultdict[str, float],
) -> dict[str, Any]:
    """The content of run.json."""
    trajectory = odometry.trajectory
    has_pose = trajectory.valid
    camera = sequence.camera
    return {
        FORMAT_KEY: FORMAT,
        "input": {
            "path": str(sequence.path if sequence.length is None else sequence.path.absolute()),
            "format": sequence.format,
            "frames": len(processed) if sequence.length is None else sequence.length,
            "first_time": _number(trajectory.times[0] if len(trajectory) else np.nan),
            "last_time": _number(trajectory.times[-1] if len(trajectory) else np.nan),
            "view": sequence.view,
            "notes": list(sequence.notes),
            "skipped": [asdict(skipped) for skipped in sequence.skipped],
        },
        "camera": {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")},
        "frontend": frontend.name,
        "configuration": to_dict(_found_from_anywhere(settings)),
        "seed": settings.odometry.seed,
        "versions": _versions(),
        "interrupted": interrupted,
        "scale": "unknown: the initial median depth is 1",
        "frames": {
            "processed": len(processed),
            "tracked": int(has_pose.sum()),
            "lost": int((~has_pose).sum()),
            "lost_frames": np.flatnonzero(~has_pose).tolist(),
            "source_index": processed,
        },
        "segments": [
            {
                **asdict(segment),
                "mean_error": _number(segment.mean_error),
                "verdict": segment.verdict.report(),
            }
            for segment in odometry.segments
        ],
        "events": [asdict(event) for event in odometry.events],
        "points": len(odometry.map),
        "tracks": dict(tracks),
        "seconds": {name: round(value, 3) for name, value in seconds.items()},
        "frames_per_second": round(len(processed) / max(seconds["total"], 1e-9), 2),
    }


def _found_from_anywhere(settings: RunSettings) -> RunSettings:
    """The settings with absolute paths, since pictures and pages of the run may be made from another folder."""
    frontend = settings.frontend
    if frontend.name.endswith(".safetensors"):
        frontend = replace(frontend, name=str(Path(frontend.name).absolute()))
    return replace(settings, sequence=with_absolute_files(settings.sequence), frontend=frontend)


def _number(value: float) -> float | None:
    """JSON has no NaN."""
    return float(value) if np.isfinite(value) else None


def _versions() -> dict[str, str]:
    """Of what the numbers of a run depend on."""
    solver = robust_solver().name
    packages = ("numpy", "numba", *(["poselib"] if solver == "poselib" else []))
    versions = {name: version(name) for name in packages}
    return {
        "improvo": __version__,
        "python": platform.python_version(),
        **versions,
        "opencv": str(cv2.__version__),
        "robust_solver": solver,
    }
