"""The file run.json, which says what was run, how, and what came of it: written, read, and put in words."""

from __future__ import annotations

import platform
from collections.abc import Iterable, Mapping
from dataclasses import asdict, replace
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np

from improvo import __version__, config
from improvo.errors import InputError
from improvo.files import check_folder_format
from improvo.formats import FORMAT, FORMAT_KEY, check_format
from improvo.frontend import Frontend
from improvo.geometry.ransac import robust_solver
from improvo.odometry.result.events import Event
from improvo.odometry.result.segments import Segment
from improvo.odometry.run_settings import RunSettings
from improvo.odometry.visual_odometry import VisualOdometry
from improvo.sequences import Sequence
from improvo.sequences.given_files import with_absolute_files
from improvo.untrusted.paths import check_path
from improvo.untrusted.text import read_json_file

_MEND = "run `improvo run` again"
_FORMER_KINDS = {"waiting": "initialising"}  # of events
_MENDS_OF_STARTS = {  # by a word of the reason
    "parallax": "the camera turned or stood still: move it sideways at the start (`improvo info` shows what it sees)",
    "match": "neighbouring frames show too little of the same place: give all frames of the video, without --stride, "
    "or see by `improvo info` whether the pictures are dark, blurred or without texture",
}


def run_json(
    sequence: Sequence,
    settings: RunSettings,
    frontend: Frontend,
    odometry: VisualOdometry,
    processed: list[int],
    interrupted: bool,
    tracks: Mapping[str, int],
    seconds: Mapping[str, float],
    segments: Iterable[Segment],
    events: Iterable[Event],
) -> dict[str, Any]:
    """The content of run.json.

    Args:
        sequence: the recording.
        settings: of the run.
        frontend: that was used.
        odometry: has finished.
        processed: the recording's index of each processed frame.
        interrupted: whether the user ended the run early.
        tracks: counts of the tracks and labels that were written.
        seconds: by what was done, with their `total`.
        segments: with their final verdicts.
        events: of the odometry, and what came after it.
    """
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
        "configuration": config.to_dict(_found_from_anywhere(settings)),
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
            for segment in segments
        ],
        "events": [asdict(event) for event in events],
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


def read_run_json(folder: Path) -> dict[str, Any]:
    """The content of a folder's run.json, by the present names. What it lacks is an `InputError` where it is asked for.

    Raises:
        InputError: there is none that can be read.
    """
    path = folder / "run.json"
    try:
        check_folder_format(folder)
        report = _told_where(_with_present_names(read_json_file(path, _MEND)), f"{path}")
        check_format(report.get(FORMAT_KEY), path, _MEND)
        check_path(Path(report["input"]["path"]))
        _check(report)
    except FileNotFoundError:
        raise InputError(f"{folder}: has no run.json; give the output folder of `improvo run`") from None
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: cannot be read ({error}); {_MEND}") from None
    return cast(dict[str, Any], report)


class _Section(dict[str, Any]):
    """A part of run.json; what it lacks is an error of the file, wherever it is asked for."""

    where = ""

    def __missing__(self, key: object) -> Any:
        raise InputError(f"{self.where}: has no `{key}`; run `improvo run` again")


def _told_where(value: Any, where: str) -> Any:
    """The same with every dictionary a section that knows its file."""
    if isinstance(value, list):
        return [_told_where(item, where) if isinstance(item, dict | list) else item for item in value]
    if not isinstance(value, dict):
        return value
    section = _Section({key: _told_where(item, where) for key, item in value.items()})
    section.where = where
    return section


def _check(report: dict[str, Any]) -> None:
    """Refuse a run.json that is not as `improvo run` writes it.

    Raises:
        ValueError, KeyError, TypeError: it is not.
    """
    frames, indices = report["frames"], report["frames"]["source_index"]
    lists = [indices, frames["lost_frames"], [frames["tracked"]]]
    if not all(isinstance(row, list) and all(type(number) is int for number in row) for row in lists):
        raise ValueError("its frames are no numbers")
    if any(b <= a for a, b in pairwise(indices)) or not all(0 <= number < 1 << 40 for number in indices):
        raise ValueError("its frames are out of order")
    if not all(isinstance(report.get(name, {}), dict) for name in ("camera", "configuration")):
        raise ValueError("its camera or configuration has no names")
    for event in report["events"]:
        if not isinstance(event["kind"], str):
            raise ValueError("an event is of no kind")


def _with_present_names(report: dict[str, Any]) -> dict[str, Any]:
    """The content of run.json, also of one that was written when events and settings had other names."""
    events = [
        {("frame_index" if key == "position" else key): value for key, value in event.items()}
        for event in report.get("events", [])
    ]
    for event in events:
        event["kind"] = _FORMER_KINDS.get(event["kind"], event["kind"])
    return {**report, "events": events, "configuration": config.with_present_names(report.get("configuration", {}))}


def unit_of(report: dict[str, Any]) -> str:
    """The unit of a run's lengths, in words, by its run.json: metres and from what they are known, or up to scale."""
    return str(report["scale"]) if report.get("metric") else "up to scale"


def metres_per_unit(report: dict[str, Any], segment: int) -> float:
    """Metres per unit of the odometry in a segment of a run, by its run.json; 1 where the run is up to scale."""
    known = {each["segment"]: each["metres_per_unit"] for each in (report.get("metric") or {}).get("segments", [])}
    before = [number for number in sorted(known) if number <= segment] or sorted(known)[:1]
    return float(known[before[-1]]) if before else 1.0


def why_no_pose(report: dict[str, Any]) -> str | None:
    """Why no frame of a run has a pose, and what helps, from its run.json; None where some have."""
    if report["frames"]["tracked"]:
        return None
    details = [str(event["detail"]) for event in report["events"] if event["kind"] == "initialising"]
    reason = details[-1] if details else "the run ended before a map could start"
    mend = next((mend for word, mend in _MENDS_OF_STARTS.items() if word in reason), _MENDS_OF_STARTS["match"])
    return f"no frame has a pose: {reason}; {mend}"
