"""Two further numbers of a calibration file: the frame rate, and the scale of depth."""

from __future__ import annotations

from improvo.geometry.camera_files import Calibration, load_calibration
from improvo.sequences.base import SequenceSettings

DEFAULT_FPS = 30.0


def frame_rate(calibration: Calibration | None, settings: SequenceSettings) -> tuple[float, str | None]:
    """Frames per second of a recording without time stamps, and a note where it is only assumed."""
    if settings.fps is not None:
        return settings.fps, None
    if settings.camera is not None:
        calibration = load_calibration(settings.camera)
    if calibration is not None and calibration.fps is not None:
        return calibration.fps, None
    return DEFAULT_FPS, f"has no time stamps; {DEFAULT_FPS:g} frames per second assumed, --fps changes it"


def depth_scale(calibration: Calibration | None, settings: SequenceSettings) -> float | None:
    """Depth value / scale = metres, as --camera or the recording's own calibration says; None where neither does."""
    given = load_calibration(settings.camera).depth_scale if settings.camera is not None else None
    return given or (calibration.depth_scale if calibration is not None else None)
