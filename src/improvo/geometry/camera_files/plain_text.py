"""Calibrations that are rows of numbers: COLMAP, DSO, DPVO and DROID, KITTI, and bare matrices."""

from __future__ import annotations

import re
from dataclasses import replace

from improvo.geometry.camera_files import colmap
from improvo.geometry.camera_files.calibration import Calibration, checked, four
from improvo.geometry.camera_files.distortion import usual_length
from improvo.geometry.camera_files.one_camera import of_matrix
from improvo.untrusted.text import is_number

_DSO_MODELS = {
    "pinhole": (5, "brown"),
    "radtan": (8, "brown"),
    "equidistant": (8, "fisheye"),
    "kannalabrandt": (8, "fisheye"),
    "fov": (5, "fov"),
    "atan": (5, "fov"),
}
# 12 or 9 bare numbers; OpenCV's files of a stereo pair have rows P1 and P2 too, but as matrices of YAML
_KITTI_ROW = re.compile(
    r"^[ \t]*(P\d|P_rect_\d\d|K_\d\d|Tr|R0_rect)[ \t]*:([ \t]+[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?){9,12}[ \t\r]*$",
    re.MULTILINE,
)
_YAML = re.compile(r"[][{}]|!!|^%YAML", re.MULTILINE)


def is_plain(text: str) -> bool:
    """Whether a text is one of these, by its first line that is no comment."""
    rows = _rows(text)
    if not rows:
        return False
    if _is_kitti(text):
        return True
    first = rows[0]
    if first[0].lower() in _DSO_MODELS and len(first) > 4:
        return True
    if len(first) > 4 and re.fullmatch(r"[A-Z_]{3,}", first[1]) and first[0].isdecimal():
        return True
    return all(is_number(field) for field in first)


def _is_kitti(text: str) -> bool:
    return _YAML.search(text) is None and _KITTI_ROW.search(text) is not None


def from_plain_text(text: str, source: str, wanted: str | None) -> Calibration:
    """The calibration in rows of numbers.

    Args:
        text: the content.
        source: the file, for messages.
        wanted: COLMAP's id, or KITTI's camera (`P2`, `02`, `K_03`); None is the first.

    Raises:
        ValueError: none of these notations, or a value that cannot be.
    """
    rows = _rows(text)
    if _is_kitti(text):
        return kitti(text, source, wanted)
    if rows and len(rows[0]) > 1 and re.fullmatch(r"[A-Z_]{3,}", rows[0][1]):
        return colmap.from_text(rows, source, wanted)
    if wanted is not None:
        raise ValueError(f"has one camera only, so there is no `{wanted}`")
    if rows and rows[0][0].lower() in _DSO_MODELS:
        return checked(_dso(rows[0][0].lower(), rows, source))
    if rows and not all(is_number(field) for row in rows[:1] for field in row):
        raise ValueError("is no calibration of COLMAP, DSO, DPVO or KITTI")
    if [len(row) for row in rows] in ([3, 3, 3], [4, 4, 4, 4], [9], [16]):
        return checked(Calibration(source, of_matrix(tuple(float(field) for row in rows for field in row), "matrix")))
    if len(rows) in (3, 4) and len(rows[1]) == 2:
        return checked(_dso({5: "fov", 8: "radtan"}.get(len(rows[0]), ""), [["", *rows[0]], *rows[1:]], source))
    if len(rows) == 1 and len(rows[0]) in (4, 8, 9, 12):
        values = [float(field) for field in rows[0]]
        return checked(Calibration(source, four(values[:4]), usual_length(tuple(values[4:]), "brown")))
    if len(rows) == 1 and len(rows[0]) == 6:  # ARKitScenes: width, height, fx, fy, cx, cy
        width, height, *values = (float(field) for field in rows[0])
        if width == int(width) > values[2] > 0.2 * width and height == int(height) > values[3] > 0.2 * height:
            return checked(Calibration(source, four(values), size=(int(width), int(height))))
    shape = f"{len(rows)} rows, the first with {len(rows[0]) if rows else 0} numbers"
    raise ValueError(f"is no calibration of COLMAP, DSO, DPVO or KITTI ({shape})")


def _dso(model: str, rows: list[list[str]], source: str) -> Calibration:
    """DSO, LSD-SLAM and the TUM mono data set: model and parameters, the images' size, what to crop, the new size."""
    if model not in _DSO_MODELS:
        raise ValueError("is no camera.txt of DSO: the first row must be fx fy cx cy and 1 or 4 coefficients")
    count, name = _DSO_MODELS[model]
    values = [float(field) for field in rows[0][1:]]
    if len(values) != count:
        raise ValueError(f"{rows[0][0]} has {count} numbers, not {len(values)}")
    if len(rows) < 2 or len(rows[1]) != 2:
        raise ValueError("has no second row with the width and height of the images")
    width, height = int(rows[1][0]), int(rows[1][1])
    fx, fy, cx, cy = values[:4]
    if cx < 1 and cy < 1:  # relative to the picture, whose corner is its origin
        fx, fy, cx, cy = fx * width, fy * height, cx * width - 0.5, cy * height - 0.5
    distortion = tuple(values[4:])
    if not any(distortion) and name != "fisheye":
        distortion, name = (), "brown"
    elif model == "pinhole":
        raise ValueError("a Pinhole row must end in 0")
    return Calibration(source, (fx, fy, cx, cy), distortion, name, (width, height))


def kitti(text: str, source: str, wanted: str | None) -> Calibration:
    """`calib.txt` of KITTI odometry (`P0` ... `P3`), or `calib_cam_to_cam.txt` of its raw drives.

    Raw drives have two cameras for each lens: that of the rectified pictures comes first, that of the distorted ones
    (`K_00`) is taken where the images have its size.

    Raises:
        ValueError: no such camera, or numbers that are missing.
    """
    rows = dict(_kitti_row(line) for line in text.splitlines() if ":" in line)
    numbered = [name for name in rows if re.fullmatch(r"P\d", name)]
    if numbered:
        name = numbered[0] if wanted is None else f"P{wanted[-1]}"
        return checked(Calibration(source, projection_intrinsics(_numbers(rows, name, 12))))
    if wanted is None:
        wanted = next((name[-2:] for name in rows if re.fullmatch(r"(P_rect|K)_\d\d", name)), "00")
    camera = wanted[-2:].rjust(2, "0")
    found = []
    if f"P_rect_{camera}" in rows and not wanted.startswith("K"):
        rectified = projection_intrinsics(_numbers(rows, f"P_rect_{camera}", 12))
        found.append(Calibration(source, rectified, size=_kitti_size(rows, f"S_rect_{camera}")))
    if f"K_{camera}" in rows:
        distortion = usual_length(_numbers(rows, f"D_{camera}", 5), "brown")
        raw = of_matrix(_numbers(rows, f"K_{camera}", 9), f"K_{camera}")
        found.append(Calibration(source, raw, distortion, "brown", _kitti_size(rows, f"S_{camera}")))
    if not found:
        raise ValueError(f"has no camera `{wanted}`; it has {', '.join(name for name in rows if 'P' in name)}")
    return checked(replace(found[0], alternatives=tuple(found[1:])))


def projection_intrinsics(values: tuple[float, ...]) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a projection matrix K [I | t] by rows."""
    return values[0], values[5], values[2], values[6]


def _kitti_row(line: str) -> tuple[str, list[str]]:
    name, _, values = line.partition(":")
    return name.strip(), values.split()


def _numbers(rows: dict[str, list[str]], name: str, count: int) -> tuple[float, ...]:
    try:
        values = tuple(float(field) for field in rows[name])
    except (KeyError, ValueError):
        values = ()
    if len(values) != count:
        raise ValueError(f"has no row `{name}:` with {count} numbers")
    return values


def _kitti_size(rows: dict[str, list[str]], name: str) -> tuple[int, int] | None:
    if name not in rows:
        return None
    width, height = _numbers(rows, name, 2)
    return int(width), int(height)


def _rows(text: str) -> list[list[str]]:
    lines = (line.split("#")[0].strip() for line in text.splitlines())
    return [re.split(r"[\s,;]+", line.strip(",;")) for line in lines if line]
