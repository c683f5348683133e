"""Features of the raw, distorted pictures of a recording: detected once, whatever the lens turns out to be."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.frontend import Frontend
from improvo.frontend.masking import features_of
from improvo.sequences.base import SequenceSettings
from improvo.sequences.opening import open_sequence
from improvo.sequences.sequence import Sequence
from improvo.types import Features, Float64, UInt8

_ANY_FOV = 60.0  # opens the recording without undistorting it; nothing else depends on it
# Pixels by which a detector puts all its keypoints too far right and down: OpenCV's SIFT looks first at a picture of
# twice the size, whose pixel centres it takes for those of every second pixel. The principal point would be as far off.
_OFF = {"sift": 0.25}


@dataclass(frozen=True)
class Piece:
    """Consecutive frames of a recording, by their features."""

    features: tuple[Features, ...]  # pixels of the picture as it was detected on
    times: tuple[float, ...]  # seconds


def open_raw(path: Path | str, settings: SequenceSettings, max_width: int | None = None) -> Sequence:
    """A recording whose frames are its own pictures, distortion and all, at most so many pixels wide if that is said.

    Raises:
        InputError: as `open_sequence`; a recording that is live.
    """
    plain = replace(settings, camera=None, fov=_ANY_FOV, undistorted_fov=None, width=None)
    sequence = open_sequence(path, plain)
    if sequence.length is None:
        raise InputError(f"{path}: is live, so its camera cannot be found from it; record a video first, or give --fov")
    if max_width is not None and sequence.camera.width > max_width:
        sequence = open_sequence(path, replace(plain, width=max_width))
    return sequence


def sampled_pictures(sequence: Sequence, samples: int) -> Iterator[tuple[str, UInt8]]:
    """Source and picture (H, W) of up to `samples` frames spread over a recording, masked pixels in an even grey.

    Args:
        sequence: from `open_raw`.
        samples: frames that are tried; those that cannot be read are left out.
    """
    rows = np.unique(np.linspace(0, len(sequence) - 1, min(samples, len(sequence))).astype(int))
    for row in rows.tolist():
        try:
            frame = sequence[row]
        except InputError:  # this frame is damaged
            continue
        even = np.uint8(frame.image.mean())
        yield frame.source, frame.image if frame.mask is None else np.where(frame.mask, frame.image, even)


def piece_rows(times: Float64, frames: int, pieces: int, max_rate: float) -> list[range]:
    """Rows of the pieces: all frames that are used, or `pieces` of equal length spread over them.

    Args:
        times: (N,) seconds of the recording's frames.
        frames: at most, in all pieces.
        pieces: where there are more.
        max_rate: frames a second that are enough; every second, third, ... frame is used where as many are left then
            (a tenth fewer at most). So of a recording of less than twice that rate all are.
    """
    interval = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    step = max(1, int(1.1 / (max_rate * interval))) if interval > 0 else 1
    count = (len(times) + step - 1) // step
    if count <= frames:
        return [range(0, len(times), step)]
    length = frames // pieces
    starts = np.linspace(0, count - length, pieces).astype(int).tolist()
    return [range(step * start, step * (start + length), step) for start in starts]


def detect_pieces(
    sequence: Sequence, rows: list[range], frontend: Frontend, progress: Callable[[], object] = lambda: None
) -> list[Piece]:
    """Features of pieces of a recording, where the picture has them; frames that cannot be read are left out.

    Args:
        sequence: from `open_raw`.
        rows: of each piece, from `piece_rows`.
        frontend: detects them.
        progress: is called after every frame.
    """
    found = []
    for chosen in rows:
        features, times = [], []
        for row in chosen:
            try:
                frame = sequence[row]
            except InputError:  # this frame is damaged
                continue
            finally:
                progress()
            found_here = features_of(frontend, frame)
            off = np.float32(_OFF.get(frontend.name, 0.0))
            features.append(replace(found_here, keypoints=found_here.keypoints - off))
            times.append(frame.time)
        found.append(Piece(tuple(features), tuple(times)))
    return found
