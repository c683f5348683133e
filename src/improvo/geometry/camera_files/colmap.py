"""COLMAP's cameras, as text and as binary. It counts pixels from their corner, so its principal points move by half."""

from __future__ import annotations

import struct
from dataclasses import replace

from improvo.errors import InputError
from improvo.geometry.camera_files.calibration import Calibration, Four, checked, four

# model -> its number in `cameras.bin`, and how many parameters it has (COLMAP's documentation, "Camera Models")
MODELS = {
    "SIMPLE_PINHOLE": (0, 3),
    "PINHOLE": (1, 4),
    "SIMPLE_RADIAL": (2, 4),
    "RADIAL": (3, 5),
    "OPENCV": (4, 8),
    "OPENCV_FISHEYE": (5, 8),
    "FULL_OPENCV": (6, 12),
    "FOV": (7, 5),
    "SIMPLE_RADIAL_FISHEYE": (8, 4),
    "RADIAL_FISHEYE": (9, 5),
}
_UNSUPPORTED = {"THIN_PRISM_FISHEYE": (10, 12), "RAD_TAN_THIN_PRISM_FISHEYE": (11, 16)}

Row = tuple[str, Calibration]


def from_text(rows: list[list[str]], source: str, wanted: str | None) -> Calibration:
    """The wanted camera of `cameras.txt`, the first without; the others are its alternatives, if they can be used.

    Args:
        rows: fields of the lines that are no comments.
        source: the file, for messages.
        wanted: the id of a camera.

    Raises:
        ValueError: not such a file, a model that is not supported, or no such camera.
    """
    found: list[Row] = []
    for fields in rows:
        if len(fields) < 5:
            raise ValueError("has no COLMAP camera row (CAMERA_ID MODEL WIDTH HEIGHT PARAMS...)")
        number, model, width, height, *parameters = fields
        if wanted is not None and number != wanted:
            found.append((number, Calibration(source, (1, 1, 0, 0))))
            continue
        try:
            values = [float(value) for value in parameters]
            found.append((number, colmap_calibration(source, model, (int(width), int(height)), values)))
        except (ValueError, InputError):
            if wanted is not None or not found:
                raise
    return _chosen(found, wanted)


def from_binary(data: bytes, source: str, wanted: str | None) -> Calibration:
    """The same of `cameras.bin`.

    Raises:
        ValueError: as `from_text`, or the file is cut short.
    """
    names = {number: (name, count) for name, (number, count) in (MODELS | _UNSUPPORTED).items()}
    found: list[Row] = []
    try:
        (count,) = struct.unpack_from("<Q", data)
        offset = 8
        for _ in range(count):
            camera, model, width, height = struct.unpack_from("<iiQQ", data, offset)
            if model not in names:  # how long its row is, and so where the next one begins, is not known
                if any(wanted in (None, number) for number, _ in found):
                    break
                raise ValueError(f"COLMAP model number {model} is not supported; known: {', '.join(MODELS)}")
            name, parameters = names[model]
            values = list(struct.unpack_from(f"<{parameters}d", data, offset + 24))
            offset += 24 + 8 * parameters
            if wanted is not None and str(camera) != wanted:
                found.append((str(camera), Calibration(source, (1, 1, 0, 0))))
                continue
            try:
                found.append((str(camera), colmap_calibration(source, name, (width, height), values)))
            except (ValueError, InputError):
                if wanted is not None or not found:
                    raise
    except struct.error:
        raise ValueError("is no COLMAP cameras.bin, or is cut short") from None
    return _chosen(found, wanted)


def _chosen(found: list[Row], wanted: str | None) -> Calibration:
    rows = [calibration for number, calibration in found if wanted is None or number == wanted]
    if not rows:
        names = ", ".join(number for number, _ in found) or "none"
        raise ValueError(f"has no camera `{wanted}`; it has {names}")
    return checked(replace(rows[0], alternatives=tuple(rows[1:])))


def colmap_calibration(source: str, model: str, size: tuple[int, int], parameters: list[float]) -> Calibration:
    """A camera of COLMAP as a calibration.

    Args:
        source: the file, for messages.
        model: COLMAP's name of the camera model.
        size: width and height of the images.
        parameters: in COLMAP's order; its principal point counts from the corner of the top-left pixel.

    Raises:
        ValueError: an unknown model or another number of parameters.
        InputError: numbers that cannot be.
    """
    (fx, fy, cx, cy), distortion, name = _parameters(model, parameters)
    return checked(Calibration(source, (fx, fy, cx - 0.5, cy - 0.5), distortion, name, size))


def _parameters(model: str, p: list[float]) -> tuple[Four, tuple[float, ...], str]:
    """COLMAP's parameters of a model, as intrinsics (its own pixels), distortion and our model name."""
    if model not in MODELS:
        raise ValueError(f"COLMAP model {model} is not supported; known: {', '.join(MODELS)}")
    count = MODELS[model][1]
    if len(p) != count:
        raise ValueError(f"COLMAP model {model} has {count} parameters, not {len(p)}")
    if model.startswith(("SIMPLE_", "RADIAL")):
        k1, k2 = (*p[3:], 0.0, 0.0)[:2]
        name = "fisheye" if model.endswith("FISHEYE") else "brown"
        return (p[0], p[0], p[1], p[2]), (k1, k2, 0.0, 0.0) if len(p) > 3 else (), name
    return four(p[:4]), tuple(p[4:]), {"OPENCV_FISHEYE": "fisheye", "FOV": "fov"}.get(model, "brown")
