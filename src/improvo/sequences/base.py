"""The interface of a format: one recording as stored on disk, before undistortion, stride and resize."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from improvo.errors import InputError
from improvo.geometry.camera_files import Calibration
from improvo.sequences.association import poses_at
from improvo.types import Float32, Float64, Int64, Trajectory, UInt8


class UnreadableFrameError(Exception):
    """One frame cannot be decoded; the sequence skips it, counts it and names it."""


@dataclass(frozen=True)
class SequenceSettings:
    """How a recording is read."""

    format: str = "auto"
    camera: str | None = None  # a calibration file, "fx,fy,cx,cy[,k1,k2,p1,p2,k3]", or auto: from the video itself
    fov: float | None = None  # horizontal field of view in degrees, if there is no calibration
    fps: float | None = None  # frame rate of recordings without time stamps
    start: int = 0  # first frame of the recording
    end: int | None = None  # one past the last frame of the recording
    stride: int = 1  # every n-th frame
    max_frames: int | None = None  # after the stride
    undistorted_fov: float | None = None  # degrees of a wide lens to show; None keeps the centre's resolution
    width: int | None = None  # resize to this width, keeping the aspect ratio
    mask: str | None = None  # one image for all frames, or a folder with one per frame; only white pixels are used
    topic: str | None = None  # the image topic of a ROS bag, or the camera of a recording with several (cam1, image_3)

    @property
    def camera_is_guess(self) -> bool:
        """Whether all that is known of the camera is a field of view, as a person guesses it."""
        return self.camera is None and self.fov is not None


class Recording(ABC):
    """One recording as stored on disk, with random access. A format is one file with one subclass.

    The constructor reads times, calibration and ground truth without decoding images. It raises `InputError` if the
    recording as a whole cannot be used, and adds a line to `notes` for what a user should know.
    """

    format: ClassVar[str]  # as in --format

    path: Path
    times: Float64  # (N,) seconds, strictly increasing
    calibration: Calibration | None = None  # of the raw images, with distortion; None where the format has none
    calibration_error: InputError | None = None  # why the recording's own calibration cannot be used
    ground_truth: Trajectory | None = None  # camera-to-world, rows at their own time stamps
    notes: tuple[str, ...] = ()  # oddities that could be handled, one line each

    @abstractmethod
    def __init__(self, path: Path, settings: SequenceSettings) -> None: ...

    @classmethod
    @abstractmethod
    def recognises(cls, path: Path) -> bool:
        """Whether the path looks like this format; cheap, no decoding."""

    def __len__(self) -> int:
        return len(self.times)

    @abstractmethod
    def source(self, index: int) -> str:
        """Where frame `index` comes from: a file, or "video.mp4#123"."""

    @abstractmethod
    def image(self, index: int) -> UInt8:
        """The raw image (H, W) grey or (H, W, 3) BGR.

        Raises:
            UnreadableFrameError: it cannot be decoded.
        """

    def own_calibration(self, *sources: Callable[[], Calibration | None]) -> Calibration | None:
        """The calibration of the first of these that has one.

        An error is kept, not raised, because the user may give another camera. `Sequence` raises it if this one is
        needed.
        """
        for source in sources:
            try:
                calibration = source()
            except InputError as error:
                self.calibration_error = error
                return None
            if calibration is not None:
                return calibration
        return None

    def present(self) -> NDArray[np.bool_]:
        """(N,) whether there is a picture, as far as that is known without reading it: a list may name absent files."""
        return np.ones(len(self), np.bool_)

    def true_poses(self, indices: Int64) -> Trajectory | None:
        """Ground truth of these frames (M,), NaN where there is none; None where the recording has none at all."""
        return None if self.ground_truth is None else poses_at(self.ground_truth, self.times[indices])

    def depth(self, index: int) -> Float32 | None:
        """Depth in metres (H, W) registered to the raw image, NaN where missing; None where there is none."""
        return None


@dataclass(frozen=True)
class SkippedFrame:
    """A frame that could not be read."""

    index: int  # position in the recording
    source: str
    reason: str
