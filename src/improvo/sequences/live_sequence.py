"""A sequence that is still being recorded."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.sequences.base import SequenceSettings
from improvo.sequences.images import grey
from improvo.sequences.live import LiveStream
from improvo.sequences.mask import chosen_mask
from improvo.sequences.rates import recording_name
from improvo.sequences.sequence import Sequence, refuse_impossible
from improvo.types import Float32, Float64, Frame, Trajectory


class LiveSequence(Sequence):
    """Frames as they come, until the source ends, `max_frames` are delivered, or nobody asks for more.

    It has no length (`len` raises TypeError, as for any Python stream) and can be iterated once; `times` are those of
    the frames so far. `notes` counts the frames that were dropped because the reader was busy.

    Raises:
        InputError: no frame came, or settings that need a recording: a start, an end, or a mask for each frame.
    """

    def __init__(self, recording: LiveStream, settings: SequenceSettings) -> None:
        try:
            _refuse_what_needs_a_recording(recording.path, settings)
        except InputError:
            recording.close()
            raise
        first = recording.next_frame()
        if first is None:
            recording.close()
            raise InputError(f"{recording.path}: opened, but no frame came; check the camera or the address")
        self._live = recording
        self._first: tuple[int, float, np.ndarray] | None = first
        self._so_far: list[float] = []
        height, width = first[2].shape[:2]
        try:
            self._set_up(recording, settings, width, height)
        except InputError:
            recording.close()
            raise

    @property
    def times(self) -> Float64:
        """(N,) seconds since 1970 of the frames delivered so far."""
        return np.array(self._so_far, np.float64)

    @property
    def ground_truth(self) -> Trajectory | None:
        return None

    @property
    def notes(self) -> tuple[str, ...]:
        dropped = self._live.dropped
        return (f"{self.path}: {dropped} frames were dropped to stay with the latest one",) if dropped else ()

    @property
    def length(self) -> int | None:
        return None

    def __len__(self) -> int:
        raise TypeError(f"{self.path} is live: its length is not known")

    def __getitem__(self, i: int) -> Frame:
        raise InputError(f"{self.path}: is live, so only the frames as they come can be read")

    def __iter__(self) -> Iterator[Frame]:
        try:
            while self.settings.max_frames is None or len(self._so_far) < self.settings.max_frames:
                latest, self._first = self._first or self._live.next_frame(), None
                if latest is None:
                    return
                index, time, image = latest
                if index % self.settings.stride or (image.shape[1], image.shape[0]) != self._raw_size:
                    continue
                self._so_far.append(time)
                yield Frame(
                    index, time, self._rectifier.image(grey(image)), self._live.source(index), self._mask(index)
                )
        finally:
            self._live.close()

    def row(self, frame: Frame) -> int:
        return self._so_far.index(frame.time)

    def depth(self, i: int) -> Float32 | None:
        return None


def _refuse_what_needs_a_recording(path: Path, settings: SequenceSettings) -> None:
    refuse_impossible(path, settings)
    if settings.start or settings.end is not None:
        given = "start" if settings.start else "end"
        raise InputError(
            f"{path}: is live, so `{given}` cannot be used: it begins with the next frame and ends with the source, or "
            "after `max_frames`"
        )
    if settings.mask is not None and chosen_mask(Path(settings.mask), recording_name(path)).is_dir():
        raise InputError(f"{settings.mask}: is a folder, and {path} is live; give one mask for all frames")
