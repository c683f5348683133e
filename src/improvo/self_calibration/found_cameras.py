"""`--camera auto`: the cameras of recordings, found once and kept as files that every later step reads."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from improvo.config import to_dict
from improvo.errors import ConfigError, InputError
from improvo.files import content_hash, write_json, write_text
from improvo.odometry.run.run_odometry import RunSummary
from improvo.self_calibration.from_motion import CameraFromMotion, Told, camera_from_motion
from improvo.self_calibration.settings import SelfCalibrationSettings
from improvo.sequences.base import SequenceSettings
from improvo.sequences.content import content_of
from improvo.sequences.given_files import mask_content
from improvo.sequences.opening import open_recording
from improvo.sequences.rates import AUTO, recording_name
from improvo.untrusted.text import read_json_file

SINGLE, FOLDER = "camera.yaml", "cameras"
_IRRELEVANT = ("camera", "fov", "undistorted_fov", "width")  # of how a recording is read
Run = TypeVar("Run", bound=RunSummary)


def find_cameras(
    recordings: Sequence[Path],
    settings: SequenceSettings,
    folder: Path,
    search: SelfCalibrationSettings | None = None,
    told: Told = lambda stage, done, total: None,
    on_found: Callable[[Path, CameraFromMotion | InputError | None], object] = lambda path, found: None,
    before: Path | None = None,
) -> SequenceSettings:
    """Settings in which `camera: auto` has become files: found from each recording, or as an earlier call left them.

    Args:
        recordings: paths; one gives `folder/camera.yaml`, several give `folder/cameras/NAME.yaml`.
        settings: how they are read; returned as they are where the camera is not `auto`.
        folder: exists.
        search: settings of the search.
        told: is called with a stage in words, and how far it is.
        on_found: is told each camera, the error of a recording that does not tell it, or None where it was there.
        before: folder of an earlier call for these recordings; what it found is copied from there.

    Raises:
        InputError: none of the recordings tells its camera.
        ConfigError: two recordings of one name.
    """
    if settings.camera != AUTO:
        return settings
    if len(recordings) == 1:
        target = folder / SINGLE
        _find(recordings[0], settings, target, search, told, on_found, None if before is None else before / SINGLE)
        return replace(settings, camera=str(target))
    names: dict[str, Path] = {}
    for path in recordings:
        name = recording_name(path)
        if names.setdefault(name, path) != path:
            raise ConfigError(f"--camera {AUTO}: two recordings are named {name}; rename one, or give --camera FILE")
    cameras = folder / FOLDER
    cameras.mkdir(exist_ok=True)
    errors: list[InputError] = []
    for name, path in names.items():
        try:
            earlier = None if before is None else before / FOLDER / f"{name}.yaml"
            _find(path, settings, cameras / f"{name}.yaml", search, told, on_found, earlier)
        except InputError as error:  # noqa: PERF203 - the others go on
            errors.append(error)
            on_found(path, error)
    if len(errors) == len(names):
        raise errors[0]
    return replace(settings, camera=str(cameras))


def with_camera_note(run: Run, camera_file: str | None) -> Run:
    """The run with what is known of its camera in run.json, where the camera was found from the motion."""
    side = None if camera_file is None else Path(camera_file).with_suffix(".json")
    if side is None or not side.is_file():
        return run
    found = read_json_file(side, "delete it")
    report = {**run.report, "camera_from_motion": found.get("found")}
    write_json(run.folder / "run.json", report)
    return replace(run, report=report)


def _find(
    path: Path,
    settings: SequenceSettings,
    target: Path,
    search: SelfCalibrationSettings | None,
    told: Told,
    on_found: Callable[[Path, CameraFromMotion | InputError | None], object],
    earlier: Path | None,
) -> None:
    """Write `target`, unless it or `earlier` is there for the same recording, read in the same way."""
    how = replace(search or SelfCalibrationSettings(), sequence=settings)
    request = _request(path, how)
    for known in (target, earlier):
        if known is not None and _is_of(known, request):
            if known != target:
                for suffix in (".yaml", ".json"):
                    write_text(target.with_suffix(suffix), known.with_suffix(suffix).read_text(encoding="utf-8"))
            on_found(path, None)
            return
    found = camera_from_motion(path, how, told)
    found.write(target, request)
    on_found(path, found)


def _is_of(camera: Path, request: dict[str, Any]) -> bool:
    side = camera.with_suffix(".json")
    if not (camera.is_file() and side.is_file()):
        return False
    return bool(read_json_file(side, "delete it").get("request") == request)


def _request(path: Path, settings: SelfCalibrationSettings) -> dict[str, Any]:
    """All that a found camera depends on, as plain JSON."""
    how = to_dict(settings)
    how["sequence"] = {name: value for name, value in how["sequence"].items() if name not in _IRRELEVANT}
    recording = open_recording(path, settings.sequence)
    what = {"recording": str(path.absolute()), "frames": len(recording), "settings": how}
    what |= {"content": content_of(recording), "mask_content": mask_content(settings.sequence)}
    weights = Path(settings.frontend.name)
    if weights.suffix == ".safetensors" and weights.is_file():
        what |= {"weights": content_hash(weights)}
    return dict(json.loads(json.dumps(what)))
