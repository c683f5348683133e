"""GPS tracks as local metres: the ellipsoid, the formats that people have, and files that are none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from improvo.errors import InputError
from improvo.geometry.position_track import is_position_track, local_metres, read_position_track, time_in_seconds


def test_metres_are_those_of_the_ellipsoid() -> None:
    # radii of curvature of WGS 84 at 45 degrees: 6367381.816 m along the meridian, 6388838.290 m across it
    east, north, up = local_metres(np.array([45.0, 45.001, 45.0, 45.0]), np.array([8, 8, 8.001, 8]), np.arange(4.0)).T
    assert north[1] == pytest.approx(np.radians(0.001) * 6367381.816, abs=1e-3)
    assert east[2] == pytest.approx(np.radians(0.001) * (6388838.290 + 2) * np.cos(np.radians(45)), abs=1e-3)
    assert (east[3], north[3], up[3]) == pytest.approx((0, 0, 3), abs=1e-6)
    poles = local_metres(np.array([90.0, -90.0]), np.zeros(2), np.zeros(2))
    assert np.linalg.norm(poles[1]) == pytest.approx(2 * 6356752.314245, abs=1e-3)


def test_times_are_dates_or_numbers() -> None:
    assert time_in_seconds("2026-05-01T10:00:00.5Z") == 1777629600.5
    assert time_in_seconds("2026-05-01T12:00:00.250+02:00") == 1777629600.25
    assert time_in_seconds("2026-05-01 10:00:00") == 1777629600.0
    assert time_in_seconds("2026-05-01T10:00:00,5Z") == 1777629600.5
    assert time_in_seconds("12.5") == time_in_seconds("12,5") == 12.5
    assert np.isnan(time_in_seconds("noon"))


GPX = """<?xml version="1.0" encoding="UTF-8"?>
<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>
<trkpt lat="45.000" lon="8.000"><ele>100.0</ele><time>2026-05-01T10:00:00Z</time></trkpt>
<trkpt lat="45.001" lon="8.000"><ele>101.0</ele><time>2026-05-01T10:00:10Z</time></trkpt>
<trkpt lat="45.002" lon="8.000"><ele>102.0</ele></trkpt>
<trkpt lat="45.001" lon="8.001"><ele>103.0</ele><time>2026-05-01T10:00:20Z</time></trkpt>
</trkseg></trk></gpx>"""
TABLES = {
    "commas": "timestamp,lat,lon,alt\n1777629600,45,8,100\n1777629610,45.001,8,101\n1777629620,45.001,8.001,103\n",
    "milliseconds": "time;Latitude [deg];Longitude [deg];Altitude (m)\n1777629600000;45;8;100\n"
    "1777629610000;45,001;8;101\n1777629620000;45,001;8,001;103\n",
    "dates": "date\tlatitude\tlng\televation\n2026-05-01T10:00:00Z\t45\t8\t100\n2026-05-01T10:00:10Z\t45.001\t8\t101\n"
    "lost\t45\t8\t1\n2026-05-01T10:00:20Z\t45.001\t8.001\t103\n",
    "spaces": "# time lat lon height\n1777629620 45.001 8.001 103\n1777629600 45 8 100\n1777629610 45.001 8 101\n",
}


@pytest.mark.parametrize("text", [GPX, *TABLES.values()], ids=["gpx", *TABLES])
def test_every_notation_gives_the_same_track(text: str, tmp_path: Path) -> None:
    (tmp_path / "track").write_text(text, encoding="utf-8")
    assert is_position_track(tmp_path / "track")
    track = read_position_track(tmp_path / "track")
    assert track.times.tolist() == [1777629600.0, 1777629610.0, 1777629620.0]
    np.testing.assert_allclose(track.xyz, [[0, 0, 0], [0, 111.13, 1.0], [78.85, 111.13, 3.0]], atol=0.01)


def test_without_heights_it_is_level(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time,lat,lon\n0,45,8\n1,45.0001,8\n2,45.0002,8\n")
    assert np.abs(read_position_track(tmp_path / "a.csv").xyz[:, 2]).max() < 1e-3


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("<gpx><trk></trk></gpx>", "has 0 places with a time"),
        ("<gpx><trk>", "is not valid XML"),
        ('<!DOCTYPE gpx [<!ENTITY a "b">]><gpx>&a;</gpx>', "defines entities"),
        ("time,lat,lon\n0,45,8\n1,95,8\n2,nan,8\n", "has 1 places with a time"),
        ("lat,lon\n45,8\n", "names no time"),
        ("", "names no time and no latitude"),
    ],
)
def test_what_is_no_track_is_one_line(text: str, what: str, tmp_path: Path) -> None:
    (tmp_path / "track").write_text(text)
    with pytest.raises(InputError, match=what) as error:
        read_position_track(tmp_path / "track")
    assert "\n" not in str(error.value)


def test_a_trajectory_is_no_gps_track(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("# timestamp tx ty tz qx qy qz qw\n0 0 0 0 0 0 0 1\n")
    assert not is_position_track(tmp_path / "a.txt")
    assert not is_position_track(tmp_path / "missing.gpx")
