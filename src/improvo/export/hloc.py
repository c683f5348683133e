"""Features and matches as hloc keeps them: HDF5 files with a group for each image and for each pair.

hloc counts pixels as we do, the centre of the top-left one at (0, 0), and moves them by half a pixel where it hands
them to COLMAP. Keypoints stay float32: float16, which hloc writes itself, rounds to half a pixel beyond 1024.
"""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from improvo.errors import imported
from improvo.export.features import MatchedFrame
from improvo.files import write_text, written_atomically
from improvo.geometry.camera import Camera

UNCERTAINTY = 1.0  # pixels of a keypoint, which hloc keeps beside them


@dataclass(frozen=True)
class Written:
    """What was written."""

    images: int
    keypoints: int
    pairs: int
    matches: int


def check_h5py() -> Any:
    """The package.

    Raises:
        MissingExtraError: it is not installed.
    """
    return imported("h5py", "writing hloc's HDF5 files", "hdf5")


class _WritableFile(io.FileIO):
    """A file for HDF5 that keeps its first error for `check`: raised in the middle, HDF5 prints it when it closes."""

    error: OSError | None = None

    def write(self, data: Any, /) -> int:
        """All of the bytes, or none of them once there was an error."""
        rest = memoryview(data).cast("B")
        size = len(rest)
        try:
            while rest and self.error is None:
                rest = rest[super().write(rest) :]
        except OSError as error:
            self.error = error
        return size

    def truncate(self, size: int | None = None, /) -> int:
        """Likewise."""
        try:
            return super().truncate(size) if self.error is None else 0
        except OSError as error:
            self.error = error
            return 0

    def check(self) -> None:
        """Raise the error, if there was one."""
        if self.error is not None:
            raise self.error


def write_hloc(frames: Iterable[MatchedFrame], camera: Camera, folder: Path, descriptors: str) -> Written:
    """Write `features.h5`, `matches.h5`, `pairs.txt`, and `intrinsics.txt` in the form of hloc's lists of queries.

    Args:
        frames: in order.
        camera: pinhole, of all of them.
        folder: of the files.
        descriptors: `float16` or `float32`.

    Raises:
        MissingExtraError: without the package h5py.
        OutputError: a file cannot be written.
    """
    h5py = check_h5py()
    names, pairs = [], []
    keypoints = matches = 0
    with (
        written_atomically(folder / "features.h5") as features_file,
        written_atomically(folder / "matches.h5") as matches_file,
        _WritableFile(features_file, "w+b") as features_out,
        _WritableFile(matches_file, "w+b") as matches_out,
        h5py.File(features_out, "w", libver="latest") as of_images,
        h5py.File(matches_out, "w", libver="latest") as of_pairs,
    ):
        counts: dict[str, int] = {}
        for frame in frames:
            group = of_images.create_group(frame.name)
            group["keypoints"] = frame.features.keypoints.astype(np.float32)
            group["keypoints"].attrs["uncertainty"] = UNCERTAINTY
            group["scores"] = frame.features.scores.astype(np.float32)
            group["descriptors"] = frame.unit.T.astype(descriptors)
            group["image_size"] = np.array([camera.width, camera.height])
            counts[frame.name] = len(frame.features)
            for earlier, found in frame.matches:
                partner = np.full(counts[earlier], -1, "int16" if len(frame.features) < 2**15 else "int32")
                partner[found[:, 0]] = found[:, 1]
                pair = of_pairs.create_group(f"{earlier}/{frame.name}")  # names without folders: hloc's own rule
                pair["matches0"] = partner
                pair["matching_scores0"] = (partner >= 0).astype(np.float16)
                pairs.append(f"{earlier} {frame.name}\n")
                matches += len(found)
            names.append(frame.name)
            keypoints += len(frame.features)
            features_out.check()
            matches_out.check()
        of_images.flush()
        of_pairs.flush()
        features_out.check()
        matches_out.check()
    numbers = (camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5)  # COLMAP's pixels
    pinhole = f"PINHOLE {camera.width} {camera.height} {' '.join(repr(float(value)) for value in numbers)}"
    write_text(folder / "intrinsics.txt", "".join(f"{name} {pinhole}\n" for name in names))
    write_text(folder / "pairs.txt", "".join(pairs))
    return Written(len(names), keypoints, len(pairs), matches)
