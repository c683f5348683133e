"""Landmarks on disk: a file of arrays per labeled sequence, made once and read as its frames are drawn.

It lies beside the tables that it was made from, `landmarks-DIGEST.safetensors`, and goes when they do. Where the label
store cannot be written, it lies in a folder of the training. A file that is damaged, or was made from other labels, is
made anew.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from improvo import config
from improvo.errors import OutputError
from improvo.files import written_atomically
from improvo.geometry.camera import Camera
from improvo.labeling.labeled import LabeledSequence
from improvo.locations import size_of
from improvo.stability.rule import STABILITY_NAMES
from improvo.stability.tables import POINTS_FILE, TRACKS_FILE
from improvo.training.data.landmarks import Landmarks, Summary, find_landmarks
from improvo.training.settings import LandmarkSettings
from improvo.untrusted.text import load_json

_FORMAT = 1
_MADE_BY = ("shared", "unstable_median_error", "unstable_largest_step")  # settings that the content depends on
_OF_FRAMES = {"cam_from_world": ("F64", (4, 4)), "frame_segment": ("I64", ()), "trusted": ("BOOL", ())}
_OF_LANDMARKS = {
    "stability": ("I8", ()), "xyz": ("F64", (3,)), "segment": ("I64", ()), "mean_error": ("F64", ()),
    "mean_direction": ("F64", (3,)), "mean_distance": ("F64", ()),
}  # fmt: skip


class _DamagedError(Exception):
    """The file is not what it should be; it is made anew."""


@dataclass(frozen=True)
class LandmarkFiles:
    """Where the files of all sequences are.

    Args:
        settings: what a landmark is.
        spare: folder for the files of label stores that cannot be written; made if need be.
    """

    settings: LandmarkSettings
    spare: Path

    def summary(self, sequence: LabeledSequence) -> Summary | None:
        """Of a file that was made before; None where there is none that is right."""
        path = self._existing(sequence)
        if path is None:
            return None
        try:
            return _read_summary(path, self._labels(sequence))
        except _DamagedError:
            return None

    def landmarks(self, sequence: LabeledSequence) -> Landmarks:
        """From the file, which is made where it is missing or damaged."""
        path = self._existing(sequence)
        if path is not None:
            try:
                return _read(path, self._labels(sequence))
            except _DamagedError:
                pass
        return self.make(sequence)[0]

    def make(self, sequence: LabeledSequence) -> tuple[Landmarks, Summary]:
        """From the tables; the file is written.

        Raises:
            InputError: the tables are damaged.
            OutputError: the file can be written in neither place.
        """
        landmarks = find_landmarks(sequence, self.settings)
        summary = landmarks.summary()
        first, second = self._places(sequence)
        try:
            _write(first, landmarks, summary, self._labels(sequence))
        except OutputError:
            _write(second, landmarks, summary, self._labels(sequence))
        return landmarks, summary

    def _existing(self, sequence: LabeledSequence) -> Path | None:
        return next((path for path in self._places(sequence) if path.is_file()), None)

    def _places(self, sequence: LabeledSequence) -> tuple[Path, Path]:
        """In the label store, and in the spare folder."""
        values = config.to_dict(self.settings)
        name = _digest({"format": _FORMAT, **{key: values[key] for key in _MADE_BY}})
        folder = _digest(str(sequence.folder.resolve()))
        return sequence.folder / f"landmarks-{name}.safetensors", self.spare / f"{folder}-{name}.safetensors"

    @staticmethod
    def _labels(sequence: LabeledSequence) -> str:
        """Which labels these are: their record, and how large their tables are."""
        sizes = [size_of(sequence.folder / name) for name in (POINTS_FILE, TRACKS_FILE)]
        return _digest([config.to_dict(sequence.record), config.to_dict(sequence.rule), sizes])


def _digest(values: Any) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]


def _write(path: Path, landmarks: Landmarks, summary: Summary, labels: str) -> None:
    from safetensors.numpy import save

    names = ("start", "keypoints", "landmark", *_OF_FRAMES, *_OF_LANDMARKS)
    arrays = {name: np.ascontiguousarray(getattr(landmarks, name)) for name in names}
    arrays["stable_by_frame"] = summary.stable_by_frame
    header = {
        "labels": labels,
        "camera": config.to_dict(landmarks.camera),
        "taught": [summary.stable, summary.unstable],
    }
    with written_atomically(path) as temporary:
        temporary.write_bytes(save(arrays, {"improvo": json.dumps(header)}))


class _Opened:
    """An open file, its header checked.

    Raises:
        _DamagedError: it cannot be read, or is of other labels.
    """

    def __init__(self, path: Path, labels: str) -> None:
        from safetensors import SafetensorError, safe_open

        self._errors = (SafetensorError, OSError, ValueError, TypeError, LookupError, AttributeError, MemoryError)
        try:
            opened: Any = safe_open
            self._file = opened(path, framework="numpy")
            self.header = load_json((self._file.metadata() or {})["improvo"])
            found = self.header["labels"]
        except self._errors:
            raise _DamagedError from None
        if found != labels:
            raise _DamagedError

    def array(self, name: str, dtype: str, shape: tuple[int | None, ...]) -> Any:
        """An array in memory; None in its shape is any number."""
        try:
            part = self._file.get_slice(name)
            found = part.get_shape()
            agrees = len(found) == len(shape) and all(
                side is None or side == given for side, given in zip(shape, found, strict=True)
            )
            if part.get_dtype() != dtype or not agrees:
                raise _DamagedError
            return self._file.get_tensor(name)
        except self._errors:
            raise _DamagedError from None


def _read_summary(path: Path, labels: str) -> Summary:
    file = _Opened(path, labels)
    try:
        stable, unstable = (int(count) for count in file.header["taught"])
    except (LookupError, TypeError, ValueError):
        raise _DamagedError from None
    return Summary(file.array("stable_by_frame", "U16", (None,)), stable, unstable)


def _read(path: Path, labels: str) -> Landmarks:
    file = _Opened(path, labels)
    start = file.array("start", "I64", (None,))
    if not len(start) or start[0] != 0 or (np.diff(start) < 0).any():
        raise _DamagedError
    frames, observations = len(start) - 1, int(start[-1])
    keypoints = file.array("keypoints", "F32", (observations, 2))
    landmark = file.array("landmark", "I32", (observations,))
    stability = file.array("stability", "I8", (None,))
    count = len(stability)
    of_frames = {name: file.array(name, dtype, (frames, *shape)) for name, (dtype, shape) in _OF_FRAMES.items()}
    of_landmarks = {name: file.array(name, dtype, (count, *shape)) for name, (dtype, shape) in _OF_LANDMARKS.items()}
    if ((landmark < 0) | (landmark >= count)).any() or ((stability < 0) | (stability >= len(STABILITY_NAMES))).any():
        raise _DamagedError
    try:
        camera = Camera(**file.header["camera"])
    except Exception:  # whatever stands there instead
        raise _DamagedError from None
    return Landmarks(camera=camera, start=start, keypoints=keypoints, landmark=landmark, **of_frames, **of_landmarks)
