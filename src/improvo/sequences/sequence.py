"""The sequence of frames that the rest of improvo sees: grey, undistorted, resized, every n-th."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from improvo.errors import InputError
from improvo.geometry.camera import Camera
from improvo.geometry.camera_files import Calibration, from_field_of_view
from improvo.sequences.base import Recording, SequenceSettings, SkippedFrame, UnreadableFrameError
from improvo.sequences.images import grey
from improvo.sequences.mask import SequenceMasks
from improvo.sequences.rates import AUTO, given_calibration, recording_name
from improvo.sequences.rectification import Rectifier
from improvo.types import Float32, Float64, Frame, Int64, Mask, Trajectory, UInt8
from improvo.untrusted.paths import as_text

_MOST_ENLARGED = 4  # times that --width may make pictures wider
_PROBES = 20  # frames tried for the image size before a recording counts as unreadable


class Sequence:
    """Frames of a recording as delivered: iterate, or take `sequence[i]`; both give the same frames.

    Row i of `times`, `depth(i)` and `ground_truth` is the i-th selected frame of the recording (after start, end,
    stride and max_frames). Iteration leaves out frames that cannot be decoded and lists them in `skipped`; `row(frame)`
    gives the row of a frame that came out.

    Raises:
        InputError: no calibration, one for another image size, no readable frame, or an empty selection.
    """

    def __init__(self, recording: Recording, settings: SequenceSettings) -> None:
        self.indices = selected(recording, settings)  # (N,) rows of the recording
        height, width = _probe(recording, self.indices).shape[:2]
        self._set_up(recording, settings, width, height)

    def _set_up(self, recording: Recording, settings: SequenceSettings, width: int, height: int) -> None:
        """Everything that follows from the size of the raw images."""
        self.recording = recording
        self.settings = settings
        self.path: Path = recording.path
        self.format = recording.format
        self.name = as_text(recording_name(recording.path))
        self._skipped: dict[int, SkippedFrame] = {}
        self._raw_size = (width, height)
        if settings.width is not None and settings.width < 8:
            raise InputError(f"{self.path}: width {settings.width} is too small; choose at least 8 pixels")
        if settings.width is not None and settings.width > _MOST_ENLARGED * width:
            raise InputError(
                f"{self.path}: width {settings.width} is more than {_MOST_ENLARGED} times that of its pictures; "
                f"they are {width} wide, and show no more when they are larger"
            )
        calibration = _calibration(recording, settings, width, height)
        self._rectifier = Rectifier(calibration.camera(width, height), settings.width, settings.undistorted_fov)
        self._masks = SequenceMasks(settings.mask, recording, self.name, self._rectifier) if settings.mask else None

    @property
    def camera(self) -> Camera:
        """The pinhole camera of the frames as delivered."""
        return self._rectifier.camera

    @property
    def raw_camera(self) -> Camera:
        """The camera of the recording's own images, with distortion."""
        return self._rectifier.raw

    @property
    def view(self) -> str:
        """What was done to the images, for a person: undistortion with its crop, resize."""
        description = self._rectifier.description
        return description if self._masks is None else f"{description}, {self._masks.description}"

    @property
    def notes(self) -> tuple[str, ...]:
        """What was odd in the recording but could be handled, one line each."""
        error = self.recording.calibration_error
        given = "--camera" if self.settings.camera is not None else "--fov"
        left_out = () if error is None else (f"its own calibration is left out for {given} ({_first_part(error)})",)
        return (*self.recording.notes, *self.absent, *left_out)

    @property
    def absent(self) -> tuple[str, ...]:
        """A note on pictures that the recording lists and that are not there; empty where all are."""
        there, listed = len(self.present), len(self.indices)
        return (f"{self.path}: {there} of {listed} listed pictures are there",) if there < listed else ()

    @property
    def skipped(self) -> list[SkippedFrame]:
        """Frames that could not be read so far, in the recording's order."""
        return [self._skipped[index] for index in sorted(self._skipped)]

    @cached_property
    def times(self) -> Float64:
        """(N,) seconds of the selected frames, the recording's own clock."""
        return self.recording.times[self.indices]

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """Camera-to-world at `times`, one row per selected frame, NaN where there is no pose; None without any."""
        return self.recording.true_poses(self.indices)

    @property
    def length(self) -> int | None:
        """The number of selected frames; None where it is not known, because the recording is still going on."""
        return len(self.indices)

    @cached_property
    def present(self) -> Int64:
        """(M,) those of `indices` whose picture is there, as far as that is known without reading it."""
        return self.indices[self.recording.present()[self.indices]]

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, i: int) -> Frame:
        """The i-th selected frame.

        Raises:
            IndexError: there is no such row.
            InputError: the frame cannot be decoded.
        """
        index = int(self.indices[i])
        frame = self._frame(index)
        if frame is None:
            raise InputError(f"{self.recording.source(index)}: {self._skipped[index].reason}; leave this frame out")
        return frame

    def __iter__(self) -> Iterator[Frame]:
        for index in self.indices:
            frame = self._frame(int(index))
            if frame is not None:
                yield frame

    def row(self, frame: Frame) -> int:
        """The row of a delivered frame in `times` and `ground_truth`, and the argument of `depth` for it."""
        return int(np.searchsorted(self.indices, frame.source_index))

    def depth(self, i: int) -> Float32 | None:
        """Depth in metres (H, W) of the i-th selected frame, same geometry as its image, NaN where missing.

        None where the recording has none for this frame or it cannot be decoded.
        """
        index = int(self.indices[i])
        try:
            depth = self.recording.depth(index)
        except UnreadableFrameError:
            return None
        if depth is None or (depth.shape[1], depth.shape[0]) != self._raw_size:
            return None
        return self._rectifier.depth(depth)

    def colour(self, i: int) -> UInt8:
        """A copy of the i-th selected frame's picture in colour (H, W, 3), BGR, same geometry as its image.

        Raises:
            InputError: the frame cannot be decoded.
        """
        index = int(self.indices[i])
        try:
            raw = self._raw_image(index)
        except UnreadableFrameError as error:
            raise InputError(f"{self.recording.source(index)}: {error}; leave this frame out") from None
        colourless = raw.ndim == 2 or raw.shape[2] == 1
        picture = self._rectifier.image(cv2.cvtColor(grey(raw), cv2.COLOR_GRAY2BGR) if colourless else raw[..., :3])
        return picture.copy() if np.may_share_memory(picture, raw) else picture  # a video keeps its last picture

    def mask(self, i: int) -> Mask | None:
        """Where keypoints may be in the i-th selected frame (H, W); None is everywhere."""
        return self._mask(int(self.indices[i]))

    def raw_mask(self, i: int) -> UInt8 | None:
        """The mask of the i-th selected frame as recorded, before undistortion (H, W): 255 used, 0 not; None is all.

        Raises:
            InputError: it cannot be read.
        """
        return None if self._masks is None else self._masks.raw(int(self.indices[i]))

    def _mask(self, index: int) -> Mask | None:
        return None if self._masks is None else self._masks[index]

    def _frame(self, index: int) -> Frame | None:
        source = self.recording.source(index)
        try:
            image = grey(self._raw_image(index))
        except UnreadableFrameError as error:
            self._skipped[index] = SkippedFrame(index, source, str(error))
            return None
        return Frame(index, float(self.recording.times[index]), self._rectifier.image(image), source, self._mask(index))

    def _raw_image(self, index: int) -> UInt8:
        image = self.recording.image(index)
        size = (image.shape[1], image.shape[0])
        if size != self._raw_size:
            first = f"{self._raw_size[0]}x{self._raw_size[1]}"
            raise UnreadableFrameError(f"is {size[0]}x{size[1]} in a recording of {first}")
        return image


def _probe(recording: Recording, indices: Int64) -> UInt8:
    """The first readable image, for its size."""
    reasons = []
    for index in indices[:_PROBES].tolist():
        image, reason = _image_or_reason(recording, index)
        if image is not None:
            return image
        reasons.append(f"{recording.source(index)}: {reason}")
    raise InputError(f"{recording.path}: none of the first frames can be read ({reasons[0]}); check the recording")


def _image_or_reason(recording: Recording, index: int) -> tuple[UInt8 | None, str]:
    try:
        return recording.image(index), ""
    except UnreadableFrameError as error:
        return None, str(error)


def selected(recording: Recording, settings: SequenceSettings) -> Int64:
    """The recording's rows that the settings ask for.

    Raises:
        InputError: impossible settings, or nothing left.
    """
    refuse_impossible(recording.path, settings)
    count = len(recording)
    end = count if settings.end is None else min(settings.end, count)
    indices = np.arange(settings.start, end, settings.stride, dtype=np.int64)[: settings.max_frames]
    if len(indices) == 0:
        raise InputError(
            f"{recording.path}: has {count} frames, none of them from {settings.start} to {end}; change start or end"
        )
    return indices


def refuse_impossible(path: Path, settings: SequenceSettings) -> None:
    """Refuse a selection of frames that no recording has.

    Raises:
        InputError: a stride or a number of frames below 1, or a negative start or end.
    """
    if settings.stride < 1:
        raise InputError(f"{path}: stride {settings.stride} must be at least 1")
    if settings.max_frames is not None and settings.max_frames < 1:
        raise InputError(f"{path}: max_frames {settings.max_frames} must be at least 1")
    if settings.start < 0 or (settings.end is not None and settings.end < 0):
        raise InputError(f"{path}: start and end count frames from 0 and cannot be negative")


def _calibration(recording: Recording, settings: SequenceSettings, width: int, height: int) -> Calibration:
    """The user's calibration, else the recording's, else one from the field of view."""
    if settings.camera == AUTO:
        raise InputError(
            f"{recording.path}: `{AUTO}` is a camera that commands look for before they open the recording; here, give "
            "the file that `improvo calibrate` or `improvo.find_camera` writes"
        )
    given = given_calibration(settings, recording.path)
    if given is not None:
        return given
    if settings.fov is not None:
        return from_field_of_view(settings.fov, width, height)
    if recording.calibration_error is not None:
        raise recording.calibration_error
    if recording.calibration is None:
        raise InputError(
            f"{recording.path}: has no calibration; give --camera FILE.yaml or fx,fy,cx,cy[,k1,k2,p1,p2,k3], "
            "or roughly --fov DEGREES (horizontal; 60 to 75 for most phones and webcams), or find it from the "
            f"motion with --camera {AUTO}"
        )
    return recording.calibration


def _first_part(error: InputError) -> str:
    """What is wrong, without the advice."""
    return str(error).split(";")[0]
