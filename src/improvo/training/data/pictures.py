"""Pictures to train on, held in memory: image folders and sequences, with what is known about their motion."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from improvo import terminal
from improvo.errors import InputError
from improvo.geometry.camera_files import folder_calibration
from improvo.geometry.trajectory_files import read_trajectory
from improvo.sequences.base import UnreadableFrameError
from improvo.sequences.images import read_grey
from improvo.types import Float64, Mask, UInt8

SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp")


@dataclass(frozen=True)
class Source:
    """One folder or sequence: a run of pictures in order."""

    name: str
    pictures: tuple[UInt8, ...]  # grey (H, W)
    names: tuple[str, ...]
    weight: float  # how often it is drawn from, relative to the others
    # (N, 3, 3) K·R_cam_from_world per picture where the camera only turned, so that homographies between pictures are
    # exact; None where that is not known
    rotating: Float64 | None = None
    masks: tuple[Mask, ...] = ()  # (H, W) each, which pixels are used; empty for all of all pictures

    def homography(self, a: int, b: int) -> Float64:
        """(3, 3) from pixels of picture a to pixels of picture b of a camera that only turns."""
        if a == b or self.rotating is None:
            return np.eye(3)
        H = self.rotating[b] @ np.linalg.inv(self.rotating[a])
        return H / H[2, 2]


@dataclass(frozen=True)
class Pictures:
    """All sources of a training, and the files that could not be read."""

    sources: tuple[Source, ...]
    skipped: tuple[str, ...] = ()

    def __len__(self) -> int:
        return sum(len(source.pictures) for source in self.sources)

    def draw(self, rng: np.random.Generator) -> tuple[int, int]:
        """A source by weight, and one of its pictures."""
        weights = np.cumsum([source.weight for source in self.sources])
        chosen = int(np.searchsorted(weights, rng.uniform(0, weights[-1]), side="right"))
        return chosen, int(rng.integers(len(self.sources[chosen].pictures)))


def load_pictures(paths: Iterable[str], longer_side: int = 320, progress: bool = False) -> Pictures:
    """Read image folders and sequences into memory, grey, reduced to `longer_side` where they are larger.

    Args:
        paths: folders or sequences, each optionally followed by `=WEIGHT`; without it a source weighs the square root
            of its number of pictures, so that long recordings leave room for short ones.
        longer_side: pixels.
        progress: show it.

    Raises:
        InputError: a source without a readable picture, or a weight that is not a positive number.
    """
    sources, skipped = [], []
    for text in terminal.each(list(paths), "reading pictures", "source", shown=progress):
        path, weight = _split_weight(text)
        pictures, names, unread = _read(path, longer_side)
        skipped += unread
        if not pictures:
            reason = f"none of its {len(unread)} pictures can be read" if unread else "has no pictures"
            raise InputError(
                f"{path}: {reason}; give a folder of images ({', '.join(SUFFIXES[:3])}, ...) or a sequence"
            )
        sources.append(
            Source(
                name=path.name,
                pictures=tuple(pictures),
                names=tuple(names),
                weight=weight if weight is not None else float(np.sqrt(len(pictures))),
                rotating=_rotating(path, len(pictures), pictures[0].shape) if not unread else None,
            )
        )
    if not sources:
        raise InputError("nothing to train on: give at least one image folder or sequence")
    return Pictures(tuple(sources), tuple(skipped))


def _split_weight(text: str) -> tuple[Path, float | None]:
    head, separator, tail = text.rpartition("=")
    if not separator or Path(text).exists():
        return Path(text), None
    try:
        weight = float(tail)
    except ValueError:
        weight = -1.0
    if not 0 < weight < float("inf"):
        raise InputError(f"{text}: the weight after `=` must be a positive number")
    return Path(head), weight


def _read(path: Path, longer_side: int) -> tuple[list[UInt8], list[str], list[str]]:
    """Pictures, their names, and the files that could not be read."""
    files = sorted(p for p in path.iterdir() if p.suffix.lower() in SUFFIXES) if path.is_dir() else []
    if not files:
        return _read_sequence(path, longer_side)
    pictures, names, unread = [], [], []
    for file in files:
        try:
            pictures.append(_reduced(read_grey(file), longer_side))
        except UnreadableFrameError:  # noqa: PERF203 - any file may be damaged
            unread.append(str(file))
        else:
            names.append(file.name)
    return pictures, names, unread


def _read_sequence(path: Path, longer_side: int) -> tuple[list[UInt8], list[str], list[str]]:
    if not path.exists():
        raise InputError(f"{path}: does not exist; give a folder of images or a sequence")
    if path.is_dir() and not any(path.iterdir()):
        return [], [], []
    from improvo.sequences import open_sequence

    sequence = open_sequence(path)
    pictures = [(_reduced(frame.image, longer_side), frame.source) for frame in sequence]
    return [p for p, _ in pictures], [n for _, n in pictures], [skip.source for skip in sequence.skipped]


def _reduced(image: UInt8, longer_side: int) -> UInt8:
    scale = longer_side / max(image.shape)
    if scale >= 1:
        return image
    size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _rotating(path: Path, count: int, shape: Sequence[int]) -> Float64 | None:
    """K·R (N, 3, 3) of every picture if the folder's poses and camera say that the camera turns without moving.

    Args:
        path: folder with `groundtruth.txt` and `camera.yaml`.
        count: of pictures; there must be as many poses.
        shape: height and width of the pictures, which must be those of the camera.
    """
    truth, (height, width) = path / "groundtruth.txt", shape
    if not truth.is_file():
        return None
    try:
        calibration = folder_calibration(path)
        if calibration is None or calibration.size != (width, height):
            return None
        camera, trajectory = calibration.camera(width, height), read_trajectory(truth, "tum")
    except InputError:
        return None
    world_from_cam = trajectory.world_from_cam
    if not camera.is_pinhole or len(trajectory) != count or not trajectory.valid.all():
        return None
    if np.ptp(world_from_cam[:, :3, 3], axis=0).max() > 1e-9:
        return None
    return np.asarray(camera.K @ world_from_cam[:, :3, :3].transpose(0, 2, 1))
