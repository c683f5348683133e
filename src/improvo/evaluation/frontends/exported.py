"""Keypoints and descriptors that another program exported: hloc's HDF5, or one NPZ per image."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from improvo.errors import InputError, imported
from improvo.frontend.masking import without_masked
from improvo.sequences import Sequence
from improvo.types import Features, Frame
from improvo.untrusted.arrays import FAULTS, check_array, read_npz
from improvo.untrusted.text import reason

HDF5_SUFFIXES = (".h5", ".hdf5")
_ARRAYS = ("keypoints", "descriptors", "scores", "image_size")  # what is read of an export


@dataclass(frozen=True)
class ExportedFeatures:
    """Features read from files.

    An image is found by the tail of its path, longest first (`redkitchen/frame-000000.color.png` before
    `frame-000000.color.png`), by `SEQUENCE/000000` or `SEQUENCE/000000.png` (number in the recording, as
    `--export-images` writes it), or, if the export holds one sequence, by `000000` alone. Where the recording's own
    names are other numbers, those are taken that more of the export fits. NPZ files have that name with `.npz` appended
    to or in place of the suffix; an HDF5 file has it as a group. Keypoints (N, 2) are in pixels of the frame as
    delivered (undistorted, resized), centre of the top-left pixel (0, 0); descriptors are (N, D), in HDF5 (D, N) as
    hloc writes them; scores (N,) are optional.
    """

    path: str  # a folder, or an HDF5 file
    label: str
    max_keypoints: int = 500
    one_sequence: bool = True  # whether names without the sequence are unambiguous

    def check(self) -> None:
        """Refuse a path that holds no features.

        Raises:
            InputError: no such folder or file, or nothing in it.
        """
        _index(self.path)

    def fingerprint(self) -> dict[str, Any]:
        """Place of the export, and names, sizes and times of its files."""
        index = _index(self.path)
        files = [Path(self.path)] if index.hdf5 else [Path(self.path) / name for name in index.names]
        stats = [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in sorted(files)]
        return {
            "exported": self.path,
            "max_keypoints": self.max_keypoints,
            "images": len(index.names),
            "files": hashlib.blake2b(repr(stats).encode(), digest_size=16).hexdigest(),
        }

    def features(self, sequence: Sequence, frame: Frame) -> Features:
        """The exported features of one frame, the best `max_keypoints`.

        Raises:
            InputError: the frame is not in the export, or its arrays have other shapes.
        """
        index = _index(self.path)
        names = candidate_names(sequence.name, frame, self.one_sequence)
        if _is_another_number(frame) and _numbered_by_index(self.path, index, sequence):
            names.sort(key=lambda name: PurePath(name).stem != f"{frame.source_index:06d}")
        found = next((name for name in names if name in index.names), None)
        if found is None:
            raise InputError(f"{self.path}: has no features for {frame.source} (looked for {names[0]}); export it")
        arrays = _read_hdf5(self.path, found) if index.hdf5 else _read_npz(Path(self.path) / found)
        where = f"{self.path}: {found}"
        exported = to_features(arrays, where, (sequence.camera.width, sequence.camera.height))
        return without_masked(exported, frame.mask).best(self.max_keypoints)


@dataclass(frozen=True)
class _Index:
    names: frozenset[str]
    hdf5: bool


@lru_cache(maxsize=4)
def _index(path: str) -> _Index:
    place = Path(path)
    if place.suffix in HDF5_SUFFIXES:
        names = _hdf5_names(path)
    elif place.is_dir():
        names = frozenset(file.relative_to(place).as_posix() for file in place.rglob("*.npz"))
        only = [file for file in place.iterdir() if file.suffix in HDF5_SUFFIXES]
        if not names and only:
            raise InputError(f"{path}: holds HDF5 features; give the file itself, {only[0]}")
    else:
        raise InputError(f"{path}: no such folder or HDF5 file of exported features; check the path")
    if not names:
        raise InputError(f"{path}: holds no exported features (.npz per image, or hloc's HDF5); see docs/evaluation.md")
    return _Index(names, place.suffix in HDF5_SUFFIXES)


def _is_another_number(frame: Frame) -> bool:
    """Whether the frame's file is named by a number that is not that of the frame."""
    stem = PurePath(frame.source).stem
    return stem.isdecimal() and stem.lstrip("0") != (str(frame.source_index) if frame.source_index else "")


@lru_cache(maxsize=16)
def _numbered_by_index(path: str, index: _Index, sequence: Sequence) -> bool:
    """Whether the names in an export are frame numbers, rather than the recording's own names."""
    stems = {PurePath(name).stem for name in index.names}
    own = sum(PurePath(sequence.recording.source(int(row))).stem in stems for row in range(len(sequence.recording)))
    counted = sum(f"{row:06d}" in stems for row in range(len(sequence.recording)))
    return counted > own


def candidate_names(sequence_name: str, frame: Frame, one_sequence: bool) -> list[str]:
    """Names under which the features of a frame may be filed, most specific first.

    Args:
        sequence_name: of the frame's sequence.
        frame: of which features are wanted.
        one_sequence: whether the run has a single sequence, so that a bare file name is enough.
    """
    parts = [part for part in PurePath(frame.source).parts if part != "/"]
    tails = ["/".join(parts[-count:]) for count in range(min(len(parts), 6), 1, -1)]
    # A bare file name, or a tail without the sequence in it, may mean a frame of another sequence.
    tails = tails if one_sequence else [tail for tail in tails if sequence_name in tail.split("/")]
    numbered = [f"{sequence_name}/{parts[-1]}", f"{sequence_name}/{frame.source_index:06d}"]
    bare = [parts[-1], f"{frame.source_index:06d}"] if one_sequence else []
    names: list[str] = []
    for stem in (*numbered, *tails, *bare):
        # a number alone is also filed as the picture that `--export-images` writes under it, as hloc keeps it
        pictures = [f"{stem}{suffix}" for suffix in (".png", ".jpg")] if stem.rsplit("/", 1)[-1].isdigit() else []
        for name in (stem, *pictures, f"{stem}.npz", str(PurePath(stem).with_suffix(".npz"))):
            if name not in names:
                names.append(name)
    return names


def to_features(arrays: dict[str, Any], where: str, image_size: tuple[int, int]) -> Features:
    """Features from exported arrays; float descriptors are normalised, uint8 ones are taken as bits.

    Args:
        arrays: `keypoints` (N, 2), `descriptors` (N, D), optionally `scores` (N,) and `image_size` (w, h).
        where: named in messages.
        image_size: width and height of the frame, which `image_size` must agree with.

    Raises:
        InputError: a missing array, another shape, NaN, or another image size.
    """
    missing = {"keypoints", "descriptors"} - set(arrays)
    if missing:
        raise InputError(f"{where}: lacks `{sorted(missing)[0]}`; see docs/evaluation.md for the layout")
    try:
        keypoints, descriptors = np.asarray(arrays["keypoints"], np.float32), np.asarray(arrays["descriptors"])
        count = len(keypoints)
        scores = np.asarray(arrays.get("scores", -np.arange(count)), np.float32)
        size = tuple(int(side) for side in np.ravel(arrays.get("image_size", image_size)))
        if descriptors.dtype != np.uint8:
            descriptors = descriptors.astype(np.float32)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where}: holds something else than numbers ({reason(error)}); export it again") from None
    if keypoints.shape != (count, 2) or descriptors.ndim != 2 or len(descriptors) != count or scores.shape != (count,):
        shapes = f"keypoints {keypoints.shape}, descriptors {descriptors.shape}, scores {scores.shape}"
        raise InputError(f"{where}: shapes do not fit ({shapes}); they are (N, 2), (N, D) and (N,)")
    if size != image_size:
        raise InputError(
            f"{where}: was exported from {size} images, the frames are {image_size}; export from the frames"
        )
    if descriptors.dtype != np.uint8:
        descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-12)
    if not (np.isfinite(keypoints).all() and np.isfinite(scores).all() and np.isfinite(descriptors).all()):
        raise InputError(f"{where}: holds NaN or infinite values; export it again")
    return Features(keypoints, descriptors, scores)


def _read_npz(path: Path) -> dict[str, Any]:
    try:
        return dict(read_npz(path, _ARRAYS.__contains__))
    except ValueError as error:
        raise InputError(f"{path}: cannot be read as NPZ ({error}); export it again") from None


def _hdf5(path: str) -> Any:
    h5py = imported("h5py", "reading hloc's HDF5 features", "hdf5")
    try:
        return h5py.File(path, "r")
    except OSError:
        raise InputError(f"{path}: no such file, or no HDF5; give hloc's feature file") from None


def _hdf5_names(path: str) -> frozenset[str]:
    names: list[str] = []
    try:
        with _hdf5(path) as file:
            file.visititems(
                lambda name, node: names.append(name) if "keypoints" in getattr(node, "keys", list)() else None
            )
    except FAULTS as error:
        raise InputError(f"{path}: is damaged ({reason(error)}); export it again") from None
    return frozenset(names)


def _read_hdf5(path: str, name: str) -> dict[str, Any]:
    arrays = {}
    try:
        with _hdf5(path) as file:
            for key in _ARRAYS:
                if key in file[name]:
                    value = file[name][key]
                    check_array(key, value.shape, value.dtype.itemsize)
                    arrays[key] = np.asarray(value)
    except FAULTS as error:
        raise InputError(f"{path}: {name}: cannot be read ({reason(error)}); export it again") from None
    if "descriptors" in arrays:
        arrays["descriptors"] = arrays["descriptors"].T
    return arrays
