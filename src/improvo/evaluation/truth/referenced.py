"""A recording with reference poses in the place of its own truth, and with their camera."""

from __future__ import annotations

import re
from functools import cached_property
from pathlib import Path, PurePosixPath

import numpy as np

from improvo.errors import ConfigError, InputError
from improvo.evaluation.truth.reference import ReferencePoses, read_reference
from improvo.sequences import Sequence, SequenceSettings
from improvo.sequences.association import poses_at
from improvo.sequences.base import Recording
from improvo.sequences.live import LiveStream
from improvo.sequences.opening import open_recording
from improvo.types import Float64, Int64, Trajectory

MAX_OFF_CENTRE = 0.2  # share of the image size by which a principal point may be off its middle


def open_with_truth(path: Path | str, settings: SequenceSettings, truth: Path | str) -> Sequence:
    """Open a recording with the poses of `truth`; its own poses are ignored.

    Where the truth has a camera, it replaces the recording's calibration.

    Args:
        path: of the recording.
        settings: how it is read.
        truth: a file of `improvo truth`, a TUM trajectory, or the folder of a COLMAP model.

    Raises:
        InputError: unreadable poses, poses of frames that the recording does not have, none of the selected frames has
            a pose, or a camera for another image size.
        ConfigError: a second camera in the settings, or a live stream.
    """
    reference = read_reference(truth)
    if reference.calibration is not None and (settings.camera is not None or settings.fov is not None):
        raise ConfigError(f"{truth}: has its own camera, which belongs to its poses; leave out --camera and --fov")
    recording = open_recording(path, settings)
    if isinstance(recording, LiveStream):
        raise ConfigError(f"{path}: is a live stream; true poses need a recording")
    return ReferencedSequence(recording, settings, reference)


class ReferencedSequence(Sequence):
    """A sequence whose truth is a reference; its frames are undistorted with the reference's camera."""

    def __init__(self, recording: Recording, settings: SequenceSettings, reference: ReferencePoses) -> None:
        self._reference = reference
        if reference.times is not None:
            truth = Trajectory(reference.times, reference.world_from_cam)
        else:
            self._frames = frames_of(reference, recording)
            order = np.argsort(self._frames)
            self._frames, poses = self._frames[order], reference.world_from_cam[order]
            truth = Trajectory(recording.times[self._frames], poses)
        recording.ground_truth = truth
        if reference.calibration is not None:
            recording.calibration = reference.calibration
        super().__init__(recording, settings)
        assert self.ground_truth is not None
        if not self.ground_truth.valid.any():
            raise InputError(self._nothing_in_common(recording))

    @cached_property
    def ground_truth(self) -> Trajectory | None:
        """Camera-to-world of the selected frames; NaN where the reference has none.

        Poses by frame number or image name are never interpolated; those by time are, as a recording's own.
        """
        truth = self.recording.ground_truth
        assert truth is not None
        if self._reference.times is not None:
            return poses_at(truth, self.times)
        poses: Float64 = np.full((len(self.indices), 4, 4), np.nan)
        row = np.searchsorted(self._frames, self.indices)
        row = np.minimum(row, len(self._frames) - 1)
        known = self._frames[row] == self.indices
        poses[known] = truth.world_from_cam[row[known]]
        return Trajectory(self.times, poses)

    def _set_up(self, recording: Recording, settings: SequenceSettings, width: int, height: int) -> None:
        """Also look whether the camera is one for images of this size: a file without a size shows it no other way."""
        calibration = self._reference.calibration
        if calibration is not None and calibration.size is None:
            _, _, cx, cy = calibration.intrinsics
            if max(abs(cx / (width - 1) - 0.5), abs(cy / (height - 1) - 0.5)) > MAX_OFF_CENTRE:
                raise InputError(
                    f"{self._reference.source}: its principal point ({cx:.0f}, {cy:.0f}) is far from the middle of "
                    f"images of {width}x{height}; it was made for images of another size"
                )
        super()._set_up(recording, settings, width, height)

    def _nothing_in_common(self, recording: Recording) -> str:
        source = self._reference.source
        if self._reference.times is None:
            own = f"frames {self._frames[0]} to {self._frames[-1]}"
            return f"{source}: has poses of {own}, none of them selected; change --start, --end or --stride"
        first, last = self._reference.times[0], self._reference.times[-1]
        return (
            f"{source}: has poses from {first:.3f} to {last:.3f} s, but no selected frame of {recording.path} has one "
            f"at its time ({self.times[0]:.3f} to {self.times[-1]:.3f} s); check the time stamps"
        )


def frames_of(reference: ReferencePoses, recording: Recording) -> Int64:
    """(N,) which frame of the recording each pose belongs to.

    Raises:
        InputError: frames that the recording does not have.
    """
    count = len(recording)
    if reference.frames is not None:
        beyond = reference.frames[reference.frames >= count]
        if len(beyond):
            raise InputError(
                f"{reference.source}: has a pose of frame {beyond[0]}, but {recording.path} has {count} frames "
                f"(0 to {count - 1}); give the poses of this recording"
            )
        return reference.frames
    assert reference.names is not None
    files = [PurePosixPath(name.replace("\\", "/")).name for name in reference.names]
    by_name = {Path(recording.source(index)).name: index for index in range(count)}
    found = [by_name.get(name, -1) for name in files]
    if max(found) < 0:  # exported images: frame_000012.png is frame 12
        numbers = [re.findall(r"\d+", Path(name).stem) for name in files]
        found = [int(digits[-1][-9:]) if digits else -1 for digits in numbers]
        found = [index if index < count else -1 for index in found]
    if min(found) < 0 or len(set(found)) < len(found):
        missing = [name for name, index in zip(files, found, strict=True) if index < 0]
        if len(missing) == len(files) or not missing:
            raise InputError(
                f"{reference.source}: its images ({files[0]}, ...) are no frames of {recording.path}; "
                "give the model of this recording"
            )
        raise InputError(
            f"{reference.source}: {len(missing)} of its {len(files)} images ({missing[0]}, ...) are no frames of "
            f"{recording.path}; give the model of this recording"
        )
    return np.array(found, np.int64)
