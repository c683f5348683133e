"""`open_sequence`: which format a path is, and the sequence it makes."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from sivo.errors import ConfigError, InputError
from sivo.sequences.base import Recording, SequenceSettings
from sivo.sequences.sequence import Sequence

# format -> class; the most telling layouts first, the plain image folder last
FORMATS: dict[str, str] = {
    "7scenes": "sivo.sequences.seven_scenes:SevenScenes",
    "tum": "sivo.sequences.tum_rgbd:TumRgbd",
    "kitti": "sivo.sequences.kitti_odometry:KittiOdometry",
    "video": "sivo.sequences.video_file:VideoFile",
    "images": "sivo.sequences.image_folder:ImageFolder",
}


def open_sequence(path: Path | str, settings: SequenceSettings | None = None, **overrides: Any) -> Sequence:
    """Open any recording by its path.

    Args:
        path: a video file, an image folder, or the folder of a data set.
        settings: how to read it; keyword arguments replace single fields (`stride=2`, `camera="camera.yaml"`).

    Raises:
        InputError: no such path, an unknown layout, no calibration or one for another image size, no readable frame.
        ConfigError: an unknown setting or format.
    """
    settings = _with_overrides(settings, overrides)
    return Sequence(open_recording(path, settings), settings)


def open_recording(path: Path | str, settings: SequenceSettings | None = None, **overrides: Any) -> Recording:
    """The recording as it lies on disk: raw images, needs no calibration. Arguments and errors as `open_sequence`."""
    settings = _with_overrides(settings, overrides)
    path = Path(path)
    if settings.fps is not None and not settings.fps > 0:
        raise InputError(f"{path}: fps {settings.fps:g} must be positive")
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; check the path")
    if path.is_dir() and not any(path.iterdir()):
        raise InputError(f"{path}: the folder is empty; give a video, an image folder or a data set")
    if settings.format == "auto":
        chosen = next((recording for _, recording in _formats() if recording.recognises(path)), None)
        if chosen is None:
            raise InputError(
                f"{path}: not recognised as any of {', '.join(format_names())}; name it with --format if it is one"
            )
    else:
        chosen = _format(settings.format)
    return chosen(path, settings)


def format_names() -> list[str]:
    """The names for --format, `auto` left out."""
    return list(FORMATS)


def _formats() -> Iterator[tuple[str, type[Recording]]]:
    for name in FORMATS:
        yield name, _format(name)


def _format(name: str) -> type[Recording]:
    if name not in FORMATS:
        raise ConfigError(f"--format {name}: unknown; known: auto, {', '.join(format_names())}")
    module, _, attribute = FORMATS[name].partition(":")
    recording: type[Recording] = getattr(importlib.import_module(module), attribute)
    return recording


def _with_overrides(settings: SequenceSettings | None, overrides: dict[str, Any]) -> SequenceSettings:
    settings = settings or SequenceSettings()
    try:
        settings = replace(settings, **overrides)
    except TypeError:
        known = ", ".join(SequenceSettings.__dataclass_fields__)
        unknown = ", ".join(name for name in overrides if name not in SequenceSettings.__dataclass_fields__)
        raise ConfigError(f"unknown sequence setting {unknown}; known: {known}") from None
    return settings if settings.camera is None else replace(settings, camera=str(settings.camera))
