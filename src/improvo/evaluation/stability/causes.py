"""The true cause of instability of tracks and keypoints, looked up in the label images of a simulated recording."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from improvo.errors import InputError
from improvo.sequences.base import UnreadableFrameError
from improvo.sequences.images import read_grey
from improvo.types import Float32, Int64, UInt8
from improvo.untrusted.paths import check_is_file
from improvo.untrusted.text import load_json

STATIC = 0
# Where the labels around a keypoint differ, the first of these is its cause.
PRECEDENCE = ("moving", "highlight", "depth_discontinuity", "shadow_edge", "repeated_texture", "static")


class TrueCauses:
    """The label images of one simulated recording.

    Args:
        folder: as `improvo simulate` leaves it.

    Raises:
        InputError: it was not made by `improvo simulate`.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            text = check_is_file(folder / "simulation.json").read_text(encoding="utf-8")
            self.codes: dict[str, int] = dict(load_json(text)["causes"])
        except (OSError, ValueError, KeyError, TypeError):
            raise InputError(
                f"{folder}: has no readable simulation.json; give a folder made by `improvo simulate`"
            ) from None
        whole = all(isinstance(code, int) and 0 <= code < 256 for code in self.codes.values())
        if set(self.codes) != set(PRECEDENCE) or not whole:
            raise InputError(f"{folder}/simulation.json: other causes than {', '.join(PRECEDENCE)}; simulate it again")
        self._rank = np.full(256, len(PRECEDENCE) - 1, np.uint8)
        for rank, name in enumerate(PRECEDENCE):
            self._rank[self.codes[name]] = rank
        self.names = PRECEDENCE

    def image(self, frame: int) -> UInt8:
        """Rank of the cause in `PRECEDENCE` per pixel (H, W) of frame `frame` of the recording."""
        path = self.folder / "labels" / f"{frame:06d}.png"
        try:
            image = read_grey(path)
        except UnreadableFrameError as error:
            raise InputError(f"{path}: is missing or no image ({error}); simulate the recording again") from None
        return np.asarray(self._rank[image], np.uint8)

    def at(self, frame: int, keypoints: Float32, width: int, reach: int = 1) -> NDArray[np.uint8]:
        """Rank of the cause at each keypoint.

        Args:
            frame: of the recording.
            keypoints: (N, 2) pixels of an image `width` pixels wide, which may differ from the labels' width.
            reach: pixels around a keypoint that count as its place.
        """
        ranks = cv2.erode(self.image(frame), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
        scale = ranks.shape[1] / width
        place = np.rint((keypoints.astype(np.float64) + 0.5) * scale - 0.5).astype(np.int64)
        x = np.clip(place[:, 0], 0, ranks.shape[1] - 1)
        y = np.clip(place[:, 1], 0, ranks.shape[0] - 1)
        return np.asarray(ranks[y, x])


def track_causes(
    truth: TrueCauses, frame: Int64, track: Int64, keypoints: Float32, source_index: Int64, width: int
) -> tuple[Int64, NDArray[np.uint8]]:
    """The cause of whole tracks: the one that most of their observations have.

    Args:
        frame, track, keypoints: (M,), (M,), (M, 2) rows of observations, as in `tracks.parquet`.
        source_index: (F,) frame of the recording of each processed frame.
        width: of the processed images.

    Returns:
        Track ids (T,), increasing, and the rank of each one's cause in `PRECEDENCE` (T,).
    """
    causes = np.zeros(len(frame), np.uint8)
    order = np.argsort(frame, kind="stable")
    bounds = np.flatnonzero(np.diff(frame[order], prepend=-1, append=np.iinfo(np.int64).max))
    for start, end in itertools.pairwise(bounds):
        rows = order[start:end]
        causes[rows] = truth.at(int(source_index[frame[rows[0]]]), keypoints[rows], width)
    ids, row_track = np.unique(track, return_inverse=True)
    votes = np.zeros((len(ids), len(PRECEDENCE)), np.int64)
    np.add.at(votes, (row_track, causes), 1)
    return ids, votes.argmax(axis=1).astype(np.uint8)
