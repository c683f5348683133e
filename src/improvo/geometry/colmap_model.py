"""Poses and camera of a COLMAP model folder, text or binary (COLMAP's documentation, "Output Format").

Poses of COLMAP are camera-from-world; pixels count from the corner of the top-left pixel.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from improvo.errors import InputError
from improvo.geometry.camera_files import Calibration, colmap_calibration
from improvo.geometry.se3 import rigid, rotation_from_quat_xyzw
from improvo.geometry.text_files import read_text
from improvo.types import Float64
from improvo.untrusted.paths import check_is_file

# COLMAP's model numbers, with the number of parameters
_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
}
_OBSERVATION_BYTES = 24  # x, y, point


@dataclass(frozen=True)
class ColmapModel:
    """The images of a model, sorted by name."""

    folder: Path
    names: tuple[str, ...]  # (N,) image files
    cam_from_world: Float64  # (N, 4, 4) in the unit of the model
    calibrations: tuple[Calibration, ...]  # (N,) the same one for all, or for each image its own

    @property
    def calibration(self) -> Calibration:
        """The camera of all images.

        Raises:
            InputError: they have several.
        """
        used = set(self.calibrations)
        if len(used) > 1:
            raise InputError(
                f"{self.folder}: its images have {len(used)} different cameras; make the model with a single one"
            )
        return used.pop()


def is_colmap_model(folder: Path) -> bool:
    """Whether a folder holds a model."""
    return any((folder / f"images.{ending}").is_file() for ending in ("bin", "txt"))


def read_colmap_model(folder: Path) -> ColmapModel:
    """The images of a model with their cameras.

    Raises:
        InputError: a damaged or missing file, an unknown camera model, or no image.
    """
    binary = (folder / "images.bin").is_file()
    try:
        cameras = _binary_cameras(folder) if binary else _text_cameras(folder)
        images = _binary_images(folder) if binary else _text_images(folder)
        names, camera_ids, quat_xyzw, translation = zip(*sorted(images), strict=True) if images else ((), (), (), ())
        calibrations = tuple(cameras[camera] for camera in camera_ids)
        rotation = rotation_from_quat_xyzw(np.array(quat_xyzw).reshape(-1, 4))
    except OSError as error:
        raise InputError(
            f"{error.filename}: cannot be read ({error.strerror}); export the COLMAP model again"
        ) from None
    except (ValueError, KeyError, IndexError, struct.error) as error:
        raise InputError(f"{folder}: is a damaged COLMAP model ({error}); export it again") from None
    if not names:
        raise InputError(f"{folder}: has no registered image; give a model with poses")
    return ColmapModel(folder, tuple(names), rigid(rotation, np.array(translation)), calibrations)


_Image = tuple[str, int, tuple[float, ...], tuple[float, ...]]  # name, camera, quat_xyzw, translation


def _text_cameras(folder: Path) -> dict[int, Calibration]:
    path = folder / "cameras.txt"
    rows = [line.split() for line in read_text(path).splitlines() if line.strip() and not line.startswith("#")]
    return {
        int(row[0]): colmap_calibration(str(path), row[1], (int(row[2]), int(row[3])), [float(v) for v in row[4:]])
        for row in rows
    }


def _text_images(folder: Path) -> list[_Image]:
    """Every second line is a pose, and the one after it the observations, which may be empty."""
    lines = [line for line in read_text(folder / "images.txt").splitlines() if not line.startswith("#")]
    found: list[_Image] = []
    for line in lines[::2]:
        if not line.strip():
            continue
        _, w, x, y, z, *translation_and_camera, name = line.split(maxsplit=9)
        *translation, camera = translation_and_camera
        quat_xyzw = (float(x), float(y), float(z), float(w))
        found.append((name, int(camera), quat_xyzw, tuple(float(value) for value in translation)))
    return found


def _binary_cameras(folder: Path) -> dict[int, Calibration]:
    path = folder / "cameras.bin"
    found = {}
    with check_is_file(path).open("rb") as file:
        for _ in range(_numbers(file, "<Q")[0]):
            number, model, width, height = _numbers(file, "<iiQQ")
            if model not in _MODELS:
                raise ValueError(f"camera model {model} is unknown")
            name, count = _MODELS[model]
            parameters = [float(value) for value in _numbers(file, f"<{count}d")]
            found[number] = colmap_calibration(str(path), name, (width, height), parameters)
    return found


def _binary_images(folder: Path) -> list[_Image]:
    found: list[_Image] = []
    with (folder / "images.bin").open("rb") as file:
        for _ in range(_numbers(file, "<Q")[0]):
            _, w, x, y, z, *translation, camera = _numbers(file, "<i7di")
            name = bytearray()
            while (byte := file.read(1)) != b"\0":
                if not byte:
                    raise ValueError("images.bin is cut short")
                name += byte
            file.seek(_OBSERVATION_BYTES * _numbers(file, "<Q")[0], 1)
            found.append((name.decode(), camera, (x, y, z, w), tuple(translation)))
    return found


def _numbers(file: BinaryIO, layout: str) -> tuple[int, ...]:
    return struct.unpack(layout, file.read(struct.calcsize(layout)))
