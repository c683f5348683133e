"""One file with everything a training reads: pictures, posed sequences with depth, licences; to be carried about."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from improvo.errors import InputError
from improvo.files import written_atomically
from improvo.frontend.weights_files import DataSource
from improvo.sequences.base import UnreadableFrameError
from improvo.sequences.images import decode
from improvo.training.data.pictures import Pictures, Source
from improvo.training.data.posed_sequence import PosedSequence
from improvo.types import Float32, Mask, UInt8
from improvo.untrusted.arrays import FAULTS
from improvo.untrusted.text import load_json, reason

_INDEX = "index.json"
_FAULTS: tuple[type[Exception], ...] = (*FAULTS, UnreadableFrameError)
_DEPTH_LEVELS = 4095  # of inverse depth: fine enough for 3 % at a twelfth of the nearest point, and small as PNG


def write_pack(
    path: Path, pictures: Pictures, posed: Sequence[PosedSequence], data: Sequence[DataSource], quality: int = 75
) -> None:
    """Write a ZIP of WebP pictures, PNG depths and masks, and `index.json`.

    Args:
        quality: of WebP.
    """
    index: dict[str, Any] = {"sources": [], "posed": [], "data": [asdict(source) for source in data]}
    index["skipped"] = list(pictures.skipped)
    with written_atomically(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as file:
        for number, source in enumerate(pictures.sources):
            names = [f"s{number}/{row}.webp" for row in range(len(source.pictures))]
            for name, picture in zip(names, source.pictures, strict=True):
                file.writestr(name, _webp(picture, quality))
            rotating = None if source.rotating is None else source.rotating.tolist()
            index["sources"].append({
                "name": source.name, "weight": source.weight, "files": names, "names": list(source.names),
                "rotating": rotating, "masks": _write_masks(file, names, source.masks),
            })  # fmt: skip
        for number, sequence in enumerate(posed):
            names = [f"p{number}/{row}.webp" for row in range(len(sequence.pictures))]
            unit = max(float(values.max()) for values in sequence.inverse_depth) / _DEPTH_LEVELS or 1.0
            for name, picture, values in zip(names, sequence.pictures, sequence.inverse_depth, strict=True):
                file.writestr(name, _webp(picture, quality))
                file.writestr(f"{name}.png", _encoded(".png", np.rint(values / unit).astype(np.uint16), 9))
            index["posed"].append({
                "name": sequence.name, "files": names, "unit": unit, "times": sequence.times.tolist(),
                "K": sequence.K.tolist(), "world_from_cam": sequence.world_from_cam.tolist(),
                "weight": sequence.weight, "masks": _write_masks(file, names, sequence.masks),
            })  # fmt: skip
        file.writestr(_INDEX, json.dumps(index))


def read_pack(path: Path) -> tuple[Pictures, list[PosedSequence], tuple[DataSource, ...]]:
    """What `write_pack` was given, up to the loss of its compression.

    Raises:
        InputError: not such a file.
    """
    try:
        with zipfile.ZipFile(path) as file:
            content = {name: file.read(name) for name in file.namelist()}
        index = load_json(content[_INDEX].decode())
        return _unpacked(content, index)
    except _FAULTS as error:
        mend = "make it with recipes/gpu_pack.py"
        raise InputError(f"{path}: is no pack of training data ({reason(error)}); {mend}") from None


def _unpacked(
    content: dict[str, bytes], index: dict[str, Any]
) -> tuple[Pictures, list[PosedSequence], tuple[DataSource, ...]]:
    with ThreadPoolExecutor() as pool:
        sources = tuple(
            Source(
                entry["name"], tuple(pool.map(_grey, (content[name] for name in entry["files"]))),
                tuple(entry.get("names", entry["files"])), entry["weight"],
                None if entry["rotating"] is None else np.array(entry["rotating"]), _masks(content, entry),
            )
            for entry in index["sources"]
        )  # fmt: skip
        posed = [
            PosedSequence(
                entry["name"], tuple(pool.map(_grey, (content[name] for name in entry["files"]))),
                np.array(entry["times"]), np.array(entry["K"]), np.array(entry["world_from_cam"]),
                tuple(_depths((content[f"{name}.png"] for name in entry["files"]), entry["unit"])),
                entry.get("weight", 1.0), _masks(content, entry),
            )
            for entry in index["posed"]
        ]  # fmt: skip
    return (
        Pictures(sources, tuple(index.get("skipped", ()))),
        posed,
        tuple(DataSource(**entry) for entry in index["data"]),
    )


def _webp(picture: UInt8, quality: int) -> bytes:
    return _encoded(".webp", picture, quality)


def _encoded(suffix: str, image: np.ndarray, level: int) -> bytes:
    flag = cv2.IMWRITE_WEBP_QUALITY if suffix == ".webp" else cv2.IMWRITE_PNG_COMPRESSION
    return bytes(cv2.imencode(suffix, image, [flag, level])[1].tobytes())


def _write_masks(file: zipfile.ZipFile, names: list[str], masks: Sequence[Mask]) -> bool:
    """Masks beside their pictures; whether there are any. Packs of earlier versions have none."""
    for name, mask in zip(names, masks, strict=bool(masks)):
        file.writestr(f"{name}.mask.png", _encoded(".png", mask.astype(np.uint8) * 255, 9))
    return bool(masks)


def _masks(content: dict[str, bytes], entry: dict[str, Any]) -> tuple[Mask, ...]:
    names = entry["files"] if entry.get("masks") else ()
    return tuple(_grey(content[f"{name}.mask.png"]) > 0 for name in names)


def _grey(content: bytes) -> UInt8:
    return np.asarray(decode(content, cv2.IMREAD_GRAYSCALE))


def _depths(contents: Iterator[bytes], unit: float) -> Iterator[Float32]:
    for content in contents:
        levels = np.asarray(decode(content, cv2.IMREAD_UNCHANGED), np.float32)
        yield levels * np.float32(unit)
