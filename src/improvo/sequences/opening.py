"""`open_sequence`: recognises the format of a path and opens it."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from itertools import islice
from pathlib import Path
from typing import Any

from improvo.errors import ConfigError, InputError
from improvo.files import never_replace
from improvo.sequences.base import Recording, SequenceSettings, UnreadableFrameError
from improvo.sequences.images import IMAGE_SUFFIXES, natural_key
from improvo.sequences.live import LiveStream, is_live
from improvo.sequences.live_sequence import LiveSequence
from improvo.sequences.sequence import Sequence, selected
from improvo.sequences.video_codec import has_sound_alone
from improvo.types import Trajectory
from improvo.untrusted.paths import check_path, check_readable

_LOOKED_AT, _NAMED = 200, 4  # entries of a folder that is no recording, and of those that are named
ENTRY_POINT = "improvo.recordings"  # the group under which other packages offer their readers

# format -> class; tried in this order: the most specific layouts first, the plain image folder last
FORMATS: dict[str, str] = {
    "live": "improvo.sequences.live:LiveStream",
    "sens": "improvo.sequences.scannet_sens:ScanNetSens",
    "rosbag": "improvo.sequences.ros_bag:RosBag",
    "record3d": "improvo.sequences.record3d:Record3d",
    "nerfstudio": "improvo.sequences.nerfstudio:Nerfstudio",
    "polycam": "improvo.sequences.polycam:Polycam",
    "scannet": "improvo.sequences.scannet_folder:ScanNetFolder",
    "7scenes": "improvo.sequences.seven_scenes:SevenScenes",
    "icl": "improvo.sequences.icl_nuim:IclNuim",
    "tum": "improvo.sequences.tum_rgbd:TumRgbd",
    "euroc": "improvo.sequences.euroc:EurocMav",
    "kitti": "improvo.sequences.kitti_odometry:KittiOdometry",
    "kitti-raw": "improvo.sequences.kitti_raw:KittiRaw",
    "video": "improvo.sequences.video_file:VideoFile",
    "colmap": "improvo.sequences.colmap_project:ColmapProject",
    "images": "improvo.sequences.image_folder:ImageFolder",
}


def open_sequence(path: Path | str, settings: SequenceSettings | None = None, **overrides: Any) -> Sequence:
    """Open any recording by its path.

    Args:
        path: a video file, an image folder, a data set, a bag, the number of a webcam, or the address of a stream.
        settings: how to read it; keyword arguments replace single fields (`stride=2`, `camera="camera.yaml"`).

    Raises:
        InputError: no such path, an unknown layout, no calibration or one for another image size, no readable frame.
        ConfigError: an unknown setting or format.
    """
    settings = _with_overrides(settings, overrides)
    recording = open_recording(path, settings)
    if isinstance(recording, LiveStream):
        return LiveSequence(recording, settings)
    return Sequence(recording, settings)


def true_trajectory(path: Path | str, settings: SequenceSettings | None = None, **overrides: Any) -> Trajectory | None:
    """True poses at the times of the selected frames, None where the recording has none; needs no calibration.

    Arguments and errors as `open_sequence`.
    """
    settings = _with_overrides(settings, overrides)
    recording = open_recording(path, settings)
    if isinstance(recording, LiveStream):
        recording.close()
        return None
    return recording.true_poses(selected(recording, settings))


def open_recording(path: Path | str, settings: SequenceSettings | None = None, **overrides: Any) -> Recording:
    """The recording as it lies on disk: raw images, needs no calibration. Arguments and errors as `open_sequence`."""
    settings = _with_overrides(settings, overrides)
    path = check_readable(check_path(Path(path)))
    if settings.fps is not None and not 1e-6 <= settings.fps <= 1e6:
        raise InputError(f"{path}: fps {settings.fps:g} is no number of frames a second; between 1e-06 and 1e+06")
    try:
        recording = _recording(path, settings)
        if path.is_file():
            never_replace(path, recording)
        return recording
    except UnreadableFrameError as error:
        raise InputError(f"{path}: {error}; copy or export the recording again") from None
    except MemoryError:
        raise InputError(f"{path}: needs more memory than there is; cut it into parts") from None
    except OSError as error:
        raise InputError(
            f"{error.filename or path}: {error.strerror or error}; check the path and permissions"
        ) from None


def is_recording(path: Path) -> bool:
    """Whether some reader takes a path; nothing is opened."""
    return any(recording.recognises(path) for recording in _formats())


def _recording(path: Path, settings: SequenceSettings) -> Recording:
    live = is_live(str(path))
    if not live and not path.exists():
        raise InputError(f"{path}: no such file or folder; check the path")
    if path.is_dir() and not any(path.iterdir()):
        raise InputError(f"{path}: the folder is empty; give a video, an image folder or a data set")
    if settings.format == "auto":
        chosen = next((recording for recording in _formats() if recording.recognises(path)), None)
        if chosen is None:
            raise InputError(f"{path}: {_why_unrecognised(path)}")
    else:
        chosen = _format(settings.format)
    return chosen(path, settings)


def _why_unrecognised(path: Path) -> str:
    """What is wrong with a path that no reader takes, and what to do."""
    if path.is_file() and path.suffix.lower() in IMAGE_SUFFIXES:
        return "is a single picture; give the folder that holds all pictures of the recording"
    if path.is_file() and has_sound_alone(path):
        return "holds sound, and no pictures; give the video"
    other = _unread_pictures(path)
    if other is not None:
        return f"holds {other} files, which are not read; convert them to JPEG or PNG"
    inside = _recordings_in(path)
    if inside:
        names = ", ".join(inside[:_NAMED]) + (", ..." if len(inside) > _NAMED else "")
        return f"is no recording itself but holds {names}; give {'that' if len(inside) == 1 else 'one of these'}"
    return f"not recognised as any of {', '.join(format_names())}; name it with --format if it is one"


def _recordings_in(folder: Path) -> list[str]:
    """Names of what a folder holds that some reader takes."""
    entries = (
        sorted(islice(folder.iterdir(), _LOOKED_AT), key=lambda path: natural_key(path.name)) if folder.is_dir() else []
    )
    found = []
    for entry in entries:
        try:
            taken = not entry.name.startswith(".") and any(recording.recognises(entry) for recording in _formats())
        except OSError:  # a folder that may not be read
            continue
        if taken:
            found.append(entry.name)
    return found


def _unread_pictures(path: Path) -> str | None:
    """The kind of picture that a folder holds and that no reader reads; None without."""
    kinds = {".heic", ".heif", ".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".jxl", ".exr", ".gif", ".raw"}
    suffixes = {file.suffix.lower() for file in path.iterdir()} & kinds if path.is_dir() else set()
    return next(iter(sorted(suffixes)), None)


def format_names() -> list[str]:
    """The names for --format, `auto` left out: our own and those of installed readers."""
    return [*_installed(), *FORMATS]


def _formats() -> Iterator[type[Recording]]:
    """Installed readers first, so that they can take over a layout of ours."""
    for name in format_names():
        yield _format(name)


def _format(name: str) -> type[Recording]:
    installed = _installed()
    if name in installed:
        try:
            return _checked(installed[name].load(), installed[name].value)
        except (ImportError, AttributeError) as error:
            raise InputError(f"reader `{name}` ({installed[name].value}) cannot be imported: {error}") from None
    if name not in FORMATS:
        raise ConfigError(f"--format {name}: unknown; known: auto, {', '.join(format_names())}")
    module, _, attribute = FORMATS[name].partition(":")
    recording: type[Recording] = getattr(importlib.import_module(module), attribute)
    return recording


def _installed() -> dict[str, EntryPoint]:
    return _installed_in(tuple(sys.path))


@cache
def _installed_in(_search_path: tuple[str, ...]) -> dict[str, EntryPoint]:
    """Readers of other packages; looking for them reads the metadata of every installed package, so it is done once."""
    return {point.name: point for point in entry_points(group=ENTRY_POINT)}


def _checked(reader: Any, where: str) -> type[Recording]:
    if not (isinstance(reader, type) and issubclass(reader, Recording)):
        raise InputError(f"reader {where}: must be a subclass of improvo.sequences.Recording; see docs/recordings.md")
    return reader


def _with_overrides(settings: SequenceSettings | None, overrides: dict[str, Any]) -> SequenceSettings:
    settings = settings or SequenceSettings()
    try:
        settings = replace(settings, **overrides)
    except TypeError:
        known = ", ".join(SequenceSettings.__dataclass_fields__)
        unknown = ", ".join(name for name in overrides if name not in SequenceSettings.__dataclass_fields__)
        raise ConfigError(f"unknown sequence setting {unknown}; known: {known}") from None
    return settings if settings.camera is None else replace(settings, camera=str(settings.camera))
