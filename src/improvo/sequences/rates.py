"""What --camera says of a recording, and two further numbers of a calibration file: frame rate and scale of depth."""

from __future__ import annotations

from pathlib import Path

from improvo.geometry.camera_files import Calibration, load_calibration
from improvo.sequences.base import SequenceSettings
from improvo.untrusted.paths import is_file

AUTO = "auto"  # as --camera: found from the motion of the recording itself, before it is opened
DEFAULT_FPS = 30.0


def given_calibration(settings: SequenceSettings, recording: Path) -> Calibration | None:
    """The calibration that --camera gives; None without one, or while it is still to be found.

    Args:
        settings: a folder as `camera` may hold a file for each recording, by the recording's name.
        recording: its path.

    Raises:
        InputError: it cannot be read.
    """
    if settings.camera is None or settings.camera == AUTO:
        return None
    own = Path(settings.camera) / f"{recording_name(recording)}.yaml"
    return load_calibration(str(own) if is_file(own) else settings.camera)


def recording_name(path: Path) -> str:
    """A short name for titles and folders: the file's stem or the folder's name."""
    name = path.stem if path.is_file() else path.absolute().name
    return name or str(path)


def frame_rate(calibration: Calibration | None, settings: SequenceSettings, path: Path) -> tuple[float, str | None]:
    """Frames per second of a recording without time stamps, and a note where it is only assumed."""
    if settings.fps is not None:
        return settings.fps, None
    for known in (given_calibration(settings, path), calibration):
        if known is not None and known.fps is not None:
            return known.fps, None
    return DEFAULT_FPS, f"has no time stamps; {DEFAULT_FPS:g} frames per second assumed, --fps changes it"


def depth_scale(calibration: Calibration | None, settings: SequenceSettings, path: Path) -> float | None:
    """Depth value / scale = metres, as --camera or the recording's own calibration says; None where neither does."""
    given = given_calibration(settings, path)
    own = calibration.depth_scale if calibration is not None else None
    return (given.depth_scale if given is not None else None) or own
