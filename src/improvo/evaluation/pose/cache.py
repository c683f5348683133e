"""Features of the frames of one sequence by one frontend, computed once, kept on disk, read by all processes."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from improvo.continuation import first_difference
from improvo.errors import InputError, OutputError
from improvo.files import temporary_name
from improvo.types import Features, Float32, Int64
from improvo.untrusted.arrays import FAULTS
from improvo.untrusted.text import load_json

FORMAT = 1
_ARRAYS = ("keypoints", "descriptors", "scores", "stability")


@dataclass(frozen=True)
class FeatureCache:
    """An opened cache: flat arrays, mapped into memory, so that processes share one copy."""

    rows: dict[int, tuple[int, int]]  # frame -> first and last + 1 row
    keypoints: Float32
    descriptors: NDArray[np.generic]
    scores: Float32
    stability: Float32 | None

    def __contains__(self, frame: int) -> bool:
        return frame in self.rows

    def __getitem__(self, frame: int) -> Features:
        start, end = self.rows[frame]
        stability = None if self.stability is None else np.array(self.stability[start:end])
        return Features(
            np.array(self.keypoints[start:end]),
            np.array(self.descriptors[start:end]),
            np.array(self.scores[start:end]),
            stability,
        )


def read_cache(folder: Path, fingerprint: dict[str, Any] | None = None) -> FeatureCache | None:
    """The cache in `folder`, or None if there is none.

    Args:
        folder: of one frontend and one sequence.
        fingerprint: all that decides the features; must be the one that the cache was made with. None: not checked.

    Raises:
        InputError: the cache was made with other settings (names the first that differs), or is damaged.
    """
    index_file = folder / "index.json"
    if not index_file.is_file():
        return None
    try:
        index = load_json(index_file.read_text(encoding="utf-8"))
        made_with, frames, ends = index["fingerprint"], index["frames"], index["ends"]
        format_version = index["format"]
        arrays = {
            name: np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False)
            for name in _ARRAYS
            if (folder / f"{name}.npy").is_file()
        }
        keypoints, descriptors, scores = arrays["keypoints"], arrays["descriptors"], arrays["scores"]
        rows = _rows(frames, ends, len(keypoints))
        whole = keypoints.shape[1:] == (2,) and descriptors.ndim == 2 and scores.ndim == 1
        whole &= all(len(array) == len(keypoints) and array.dtype.kind in "fu" for array in arrays.values())
        if not whole or not isinstance(made_with, dict):
            raise ValueError("arrays that do not belong together")
    except FAULTS:
        raise InputError(f"{folder}: is a damaged feature cache; delete that folder") from None
    now = made_with if fingerprint is None else json.loads(json.dumps(fingerprint))
    difference = first_difference({"format": format_version, **made_with}, {"format": FORMAT, **now})
    if difference:
        raise InputError(
            f"{folder}: features were cached with {difference}; delete that folder, or give another output folder"
        )
    return FeatureCache(rows, keypoints, descriptors, scores, arrays.get("stability"))


def _rows(frames: list[int], ends: list[int], count: int) -> dict[int, tuple[int, int]]:
    """First and last + 1 row of each frame.

    Raises:
        ValueError: they are not those of `count` rows.
    """
    bounds = np.array([0, *ends])
    if bounds.dtype.kind != "i" or (np.diff(bounds) < 0).any() or bounds[-1] != count:
        raise ValueError("rows out of order")
    return {int(frame): (int(a), int(b)) for frame, a, b in zip(frames, bounds[:-1], bounds[1:], strict=True)}


def write_cache(folder: Path, fingerprint: dict[str, Any], features: dict[int, Features]) -> None:
    """Write a cache; `folder` appears complete or not at all, and replaces what was there.

    Args:
        folder: of one frontend and one sequence.
        fingerprint: all that decides the features.
        features: by frame.

    Raises:
        OutputError: it cannot be written.
    """
    frames = sorted(features)
    ends: Int64 = np.cumsum([len(features[frame]) for frame in frames]).astype(np.int64)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        temporary = folder.with_name(temporary_name(folder.name))
        temporary.mkdir()
        try:
            for name in _ARRAYS:
                parts = [getattr(features[frame], name) for frame in frames]
                if parts and all(part is not None for part in parts):
                    np.save(temporary / f"{name}.npy", np.concatenate(parts), allow_pickle=False)
            index = {"format": FORMAT, "fingerprint": fingerprint, "frames": frames, "ends": ends.tolist()}
            (temporary / "index.json").write_text(json.dumps(index), encoding="utf-8")
            if folder.exists():
                shutil.rmtree(folder)
            temporary.rename(folder)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written ({error.strerror or error}); choose another folder") from None
