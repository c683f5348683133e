"""Tracks of GPS receivers: positions on the Earth with times, as local metres.

Read are GPX, and tables (CSV) whose first row names the columns: a time, a latitude and a longitude in degrees, and a
height in metres where there is one (WGS 84). Times are dates (ISO 8601, UTC where no zone is given) or numbers.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.geometry.text_files import read_text
from improvo.geometry.time_units import in_seconds
from improvo.geometry.trajectory_files import increasing_order
from improvo.types import Float64
from improvo.untrusted.text import load_xml

_MEND = "give a GPX file, or a table with columns time, latitude, longitude and height"
_SEMI_MAJOR, _FLATTENING = 6378137.0, 1 / 298.257223563  # WGS 84
_COLUMNS = {
    "time": ("time", "timestamp", "t", "date", "datetime", "utc", "gpstime", "seconds"),
    "latitude": ("latitude", "lat"),
    "longitude": ("longitude", "lon", "lng", "long"),
    "height": ("height", "altitude", "alt", "ele", "elevation", "h"),
}


@dataclass(frozen=True)
class PositionTrack:
    """Places of a receiver over time."""

    times: Float64  # (N,) seconds, increasing; since 1970 where the file has dates
    xyz: Float64  # (N, 3) metres east, north and up of the first place


def is_position_track(path: Path | str) -> bool:
    """Whether a file is GPX, or a table with a latitude in its first row; a missing file is none."""
    path = Path(path)
    if not path.is_file():
        return False
    text = read_text(path, "a trajectory or a GPS track", _MEND).lstrip()
    return _is_gpx(text) or "latitude" in _columns_of(text.partition("\n")[0])


def read_position_track(path: Path | str) -> PositionTrack:
    """The track in a GPX file or a table.

    Rows without a time or a place are left out; a track without any height is taken as level.

    Raises:
        InputError: no such file, or fewer than three places with a time.
    """
    path = Path(path)
    text = read_text(path, "a GPS track", _MEND)
    rows = _gpx_rows(text, path) if _is_gpx(text.lstrip()) else _table_rows(text, path)
    table = np.array(rows, np.float64).reshape(-1, 4)
    table = table[np.isfinite(table[:, :3]).all(axis=1)]
    table = table[(np.abs(table[:, 1]) <= 90) & (np.abs(table[:, 2]) <= 360)]
    if np.isfinite(table[:, 3]).any():
        table = table[np.isfinite(table[:, 3])]
    else:
        table[:, 3] = 0.0
    stamps, _ = in_seconds(table[:, 0], of_video=False)
    order, _ = increasing_order(stamps)
    if len(order) < 3:
        raise InputError(f"{path}: has {len(order)} places with a time, three are needed; {_MEND}")
    latitude, longitude, height = table[order, 1:].T
    return PositionTrack(stamps[order], local_metres(latitude, longitude, height))


def local_metres(latitude: Float64, longitude: Float64, height: Float64) -> Float64:
    """East, north and up (N, 3) of the first place, exact for the ellipsoid WGS 84.

    Args:
        latitude: (N,) degrees, geodetic.
        longitude: (N,) degrees.
        height: (N,) metres.
    """
    phi, lam = np.radians(latitude), np.radians(longitude)
    squared_eccentricity = _FLATTENING * (2 - _FLATTENING)
    normal = _SEMI_MAJOR / np.sqrt(1 - squared_eccentricity * np.sin(phi) ** 2)
    flat = (normal + height) * np.cos(phi)
    earth = np.stack(
        [flat * np.cos(lam), flat * np.sin(lam), (normal * (1 - squared_eccentricity) + height) * np.sin(phi)], axis=1
    )
    east = np.array([-np.sin(lam[0]), np.cos(lam[0]), 0.0])
    up = np.array([np.cos(phi[0]) * np.cos(lam[0]), np.cos(phi[0]) * np.sin(lam[0]), np.sin(phi[0])])
    return np.asarray((earth - earth[0]) @ np.stack([east, np.cross(up, east), up], axis=1))


def time_in_seconds(text: str) -> float:
    """A date and time (ISO 8601; UTC where no zone is given) in seconds since 1970, or a number as it is; else NaN.

    Either may have a decimal comma.
    """
    text = text.strip().strip("\"'").replace(",", ".")
    try:
        return float(text)
    except ValueError:
        pass
    fraction = re.search(r"\.\d+", text)  # before Python 3.11 `fromisoformat` knows three and six digits only
    whole = text.replace(fraction.group(), "", 1) if fraction else text
    try:
        when = datetime.fromisoformat(re.sub("[zZ]$", "+00:00", whole))
    except ValueError:
        return float("nan")
    when = when if when.tzinfo is not None else when.replace(tzinfo=timezone.utc)
    return when.timestamp() + (float(fraction.group()) if fraction else 0.0)


def _is_gpx(text: str) -> bool:
    return text.startswith("<") and "<gpx" in text[:2000]


def _gpx_rows(text: str, path: Path) -> list[tuple[float, float, float, float]]:
    """Time, latitude, longitude and height of each point of all tracks."""
    try:
        root = load_xml(text)
    except ValueError as error:
        raise InputError(f"{path}: is not valid XML ({error}); {_MEND}") from None
    rows = []
    for point in root.iter():
        if point.tag.rpartition("}")[2] != "trkpt":
            continue
        below = {child.tag.rpartition("}")[2]: (child.text or "") for child in point}
        rows.append(
            (
                time_in_seconds(below.get("time", "")),
                _number(point.get("lat", "")),
                _number(point.get("lon", "")),
                _number(below.get("ele", "")),
            )
        )
    return rows


def _table_rows(text: str, path: Path) -> list[tuple[float, float, float, float]]:
    lines = [line for line in text.splitlines() if line.strip()]
    columns = _columns_of(lines[0]) if lines else {}
    missing = [name for name in ("time", "latitude", "longitude") if name not in columns]
    if missing:
        raise InputError(f"{path}: its first row names no {' and no '.join(missing)}; {_MEND}")
    separator, rows = _separator(lines[0]), []
    for line in lines[1:]:
        fields = _fields(line, separator)
        field = {name: fields[column] if column < len(fields) else "" for name, column in columns.items()}
        place = (_number(field.get(name, "")) for name in ("latitude", "longitude", "height"))
        rows.append((time_in_seconds(field["time"]), *place))
    return [(time, latitude, longitude, height) for time, latitude, longitude, height in rows]


def _columns_of(header: str) -> dict[str, int]:
    """Which column is what, by its name; units in brackets do not count."""
    found: dict[str, int] = {}
    for column, field in enumerate(_fields(header.lstrip("#"), _separator(header))):
        name = re.sub(r"[(\[].*|[^a-z]", "", field.lower())
        for meaning, names in _COLUMNS.items():
            if name in names:
                found.setdefault(meaning, column)
    return found


def _separator(header: str) -> str | None:
    return next((mark for mark in (";", "\t", ",") if mark in header), None)


def _fields(line: str, separator: str | None) -> list[str]:
    return [field.strip().strip("\"'") for field in line.strip().split(separator)]


def _number(text: str) -> float:
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return float("nan")
