"""Where the keypoints of pictures are: point labels, how detectors agree on them, and their file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from improvo.errors import InputError
from improvo.files import written_atomically
from improvo.training.augmentation.views import inside, warp_points
from improvo.training.settings import AdaptationSettings
from improvo.types import Float32, Float64, Int64
from improvo.untrusted.arrays import read_npz
from improvo.untrusted.limits import MAX_TABLE_BYTES
from improvo.untrusted.text import reason

IGNORED = -1  # the value of a cell that says nothing
DUSTBIN = 64  # the value of a cell without a keypoint


@dataclass(frozen=True)
class PointLabels:
    """Candidate keypoints of one picture, best first."""

    points: Float32  # (N, 2) pixels of the picture
    agreement: Float32  # (N,) share of the views that see the place in which the detector found the point


def label_cells(
    points: Float64 | Float32,
    agreement: Float32,
    visible: np.ndarray,
    width: int,
    height: int,
    settings: AdaptationSettings,
) -> Int64:
    """What the detector head is taught about a view: (Hc, Wc) the pixel of the keypoint 0..63, DUSTBIN or IGNORED.

    Args:
        points: (N, 2) labeled points in pixels of the view, best first; NaN where not visible.
        agreement: (N,) see `PointLabels`.
        visible: (height, width) bool, where the view shows the picture and not its mirrored outside.
        width: of the view, pixels, a multiple of 8.
        height: of the view, pixels, a multiple of 8.
        settings: from which agreement on a point is a label, or ignored.
    """
    cells = np.full((height // 8, width // 8), DUSTBIN, np.int64)
    cells[~visible.reshape(height // 8, 8, width // 8, 8).all(axis=(1, 3))] = IGNORED
    pixels = np.round(points)
    seen = inside(pixels, width, height)
    pixels, agreement = pixels[seen].astype(np.int64), agreement[seen]
    accepted = agreement >= settings.accepted
    undecided = pixels[~accepted & (agreement >= settings.undecided)]
    cells[undecided[:, 1] // 8, undecided[:, 0] // 8] = IGNORED
    x, y = pixels[accepted][::-1].T  # the best of a cell is written last
    keep = visible[y, x]
    x, y = x[keep], y[keep]
    cells[y // 8, x // 8] = (y % 8) * 8 + x % 8
    return cells


class Consensus:
    """Collects detections in many views of one picture; its peaks are places that are found again."""

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        self.found = np.zeros((height, width), np.float32)
        self.seen = np.zeros((height, width), np.float32)

    def add(self, keypoints: Float32, view_from_picture: Float64, view_size: tuple[int, int], border: int) -> None:
        """Count the detections in one view.

        Args:
            keypoints: (N, 2) pixels of the view.
            view_from_picture: (3, 3) homography.
            view_size: width, height.
            border: pixels along the edge of the view that are not counted.
        """
        picture_from_view = np.linalg.inv(view_from_picture)
        mask = np.zeros(view_size[::-1], np.float32)
        mask[border : view_size[1] - border, border : view_size[0] - border] = 1
        self.seen += cv2.warpPerspective(mask, picture_from_view, (self.width, self.height), flags=cv2.INTER_NEAREST)
        keypoints = keypoints[inside(keypoints, *view_size, margin=border)]
        places = np.round(warp_points(picture_from_view, keypoints))
        x, y = places[inside(places, self.width, self.height)].astype(np.int64).T
        hits = np.zeros_like(self.found)
        hits[y, x] = 1
        # a detection one pixel off still counts, less; the peak of the sum is then the mean place
        self.found += np.minimum(cv2.GaussianBlur(hits, (5, 5), 1.0) * np.float32(2 * np.pi), 1.0)

    def labels(self, settings: AdaptationSettings) -> PointLabels:
        """Peaks of the share of views in which a place was found, non-maximum suppressed."""
        enough = self.seen >= max(2.0, settings.views / 6)
        agreement = np.where(enough, self.found / np.maximum(self.seen, 1), 0)
        agreement = cv2.GaussianBlur(agreement, (3, 3), 0.6)
        size = 2 * settings.suppression + 1
        peak = (agreement == cv2.dilate(agreement, np.ones((size, size), np.uint8))) & (agreement >= settings.undecided)
        y, x = np.nonzero(peak)
        order = np.argsort(-agreement[y, x], kind="stable")
        points = np.stack([x, y], axis=1).astype(np.float32)[order]
        return PointLabels(points, np.minimum(agreement[y, x][order], 1).astype(np.float32))


def save_labels(path: Path, labels: list[list[PointLabels]]) -> None:
    """One file for all sources and pictures (NumPy's npz)."""
    flat = [picture for source in labels for picture in source]
    with written_atomically(path) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(
            stream,
            pictures=np.array([len(source) for source in labels], np.int64),
            counts=np.array([len(picture.points) for picture in flat], np.int64),
            points=np.concatenate([picture.points for picture in flat]),
            agreement=np.concatenate([picture.agreement for picture in flat]),
        )


def load_labels(path: Path, pictures: list[int]) -> list[list[PointLabels]]:
    """Read labels back; `pictures` is the number of pictures of each source, which must agree.

    Raises:
        InputError: not such a file, or labels of other pictures.
    """
    try:
        data = read_npz(path, limit=MAX_TABLE_BYTES)
        counts, points, agreement = data["counts"], data["points"], data["agreement"]
        stored = data["pictures"].tolist()
        whole = counts.dtype.kind == data["pictures"].dtype.kind == "i" and counts.ndim == 1 and (counts >= 0).all()
        whole = whole and points.shape == (counts.sum(), 2) and agreement.shape == (counts.sum(),)
        if not whole or sum(stored) != len(counts) or not (points.dtype.kind == agreement.dtype.kind == "f"):
            raise ValueError("its arrays do not belong together")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        mend = "remove it to make it anew"
        raise InputError(f"{path}: cannot be read as keypoint labels ({reason(error)}); {mend}") from None
    if stored != pictures:
        raise InputError(f"{path}: holds labels of other pictures; remove it to make it anew")
    ends = np.cumsum(counts)
    flat = [
        PointLabels(points[end - count : end], agreement[end - count : end])
        for end, count in zip(ends, counts, strict=True)
    ]
    result, start = [], 0
    for number in stored:
        result.append(flat[start : start + number])
        start += number
    return result
