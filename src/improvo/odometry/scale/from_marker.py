"""Scale by square markers of known size: AprilTags or ArUco markers in view."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from improvo.errors import ConfigError, InputError
from improvo.geometry.triangulation import triangulate_tracks
from improvo.odometry.scale.estimate import ScaleEstimate
from improvo.odometry.scale.settings import ScaleSettings
from improvo.odometry.scale.tracked import TrackedRun
from improvo.sequences import Sequence
from improvo.types import Float64, UInt8

DICTIONARIES = (
    "DICT_APRILTAG_36h11",
    "DICT_4X4_50",
    "DICT_5X5_100",
    "DICT_6X6_250",
    "DICT_7X7_250",
    "DICT_ARUCO_ORIGINAL",
    "DICT_APRILTAG_25h9",
    "DICT_APRILTAG_16h5",
)  # the most common first
_MOST_FRAMES = 400  # that are looked at
_PROBES = 60  # of them with every dictionary
_LEAST_VIEWS = 3  # of a marker; a single one is more often a false alarm
_MIN_PARALLAX_DEG = 1.5
_MOST_SPREAD = 0.2  # between sides, relative
_aruco: Any = cv2.aruco  # its type stubs lack parts


@dataclass(frozen=True)
class SeenMarker:
    """The corners of one marker in one frame."""

    source_index: int  # frame of the recording
    number: int  # of the marker
    corners: Float64  # (4, 2) pixels, clockwise


def find_markers(
    sequence: Sequence, settings: ScaleSettings, progress: Callable[[int], object] = lambda _: None
) -> list[SeenMarker]:
    """Markers in the frames of a sequence, before any other work; those seen in fewer than three frames are left out.

    Raises:
        InputError: none was seen.
        ConfigError: an unknown dictionary.
    """
    names = DICTIONARIES if settings.marker_dictionary == "auto" else (settings.marker_dictionary,)
    detectors = {name: _detector(name) for name in names}
    rows = np.unique(np.linspace(0, len(sequence) - 1, min(_MOST_FRAMES, len(sequence))).astype(int)).tolist()
    probes = set(rows[:: max(1, len(rows) // _PROBES)]) if len(detectors) > 1 else set()
    seen: dict[str, int] = dict.fromkeys(detectors, 0)
    for row in sorted(probes):
        image = _image(sequence, row)
        if image is not None:
            for name, detector in detectors.items():
                seen[name] += len(_markers(detector, image))
    chosen = max(seen, key=lambda name: seen[name])
    found = []
    for row in rows:
        image = _image(sequence, row)
        if image is not None:
            markers = _markers(detectors[chosen], image)
            counts = Counter(number for number, _ in markers)
            found += [SeenMarker(int(sequence.indices[row]), n, c) for n, c in markers if counts[n] == 1]
        progress(1)
    views = Counter(marker.number for marker in found)
    found = [marker for marker in found if views[marker.number] >= _LEAST_VIEWS]
    if not found:
        raise InputError(
            f"--scale marker: no marker was seen in at least {_LEAST_VIEWS} of {len(rows)} frames; it must be an "
            "AprilTag or ArUco marker (scale.marker_dictionary), whole, sharp and some 30 pixels wide"
        )
    return found


def scale_from_marker(run: TrackedRun, markers: list[SeenMarker], settings: ScaleSettings) -> dict[int, ScaleEstimate]:
    """By segment, where a marker was seen from different places: its corners are triangulated by the run's poses.

    Raises:
        InputError: in no segment, or sides that contradict each other.
    """
    assert settings.metres is not None
    frame_of = {int(index): frame for frame, index in enumerate(run.source_index)}
    found = {}
    for segment in run.segments:
        sides: list[Float64] = []
        for number in sorted({marker.number for marker in markers}):
            views = [
                (frame_of[marker.source_index], marker.corners)
                for marker in markers
                if marker.number == number and marker.source_index in frame_of
            ]
            views = [(frame, corners) for frame, corners in views if run.trajectory.segment[frame] == segment]
            triangulated = _sides(run, views)
            if triangulated is not None:
                sides.append(triangulated)
        if not sides:
            continue
        lengths = np.concatenate(sides)
        middle = float(np.median(lengths))
        spread = float(np.std(lengths, ddof=1)) / middle
        if spread > _MOST_SPREAD:
            raise InputError(
                f"--scale marker: contradicts itself, the sides of the markers differ by {100 * spread:.0f} % in the "
                "run; they must stand still and be of one size"
            )
        # the four sides of a marker share most of their error, so that markers count and not sides
        error = max(spread, 0.002) / np.sqrt(len(sides))
        found[segment] = ScaleEstimate(settings.metres / middle, float(error), len(sides))
    if not found:
        raise InputError(
            "--scale marker: no marker was seen from places different enough to measure it; move sideways while it is "
            "in view"
        )
    return found


def _sides(run: TrackedRun, views: list[tuple[int, Float64]]) -> Float64 | None:
    """The four sides (4,) of a marker in units of the run; None where it was not seen well enough."""
    if len(views) < _LEAST_VIEWS:
        return None
    frames = np.array([frame for frame, _ in views], np.int64)
    pixels = np.stack([corners for _, corners in views], axis=1)  # (4, V, 2)
    offsets = np.arange(5) * len(views)
    result = triangulate_tracks(pixels.reshape(-1, 2), np.tile(frames, 4), offsets, run.cam_from_world, run.camera.K)
    if not result.in_front.all() or result.parallax_deg.min() < _MIN_PARALLAX_DEG:
        return None
    return np.asarray(np.linalg.norm(result.points - np.roll(result.points, -1, axis=0), axis=1))


def _detector(name: str) -> Any:
    if not hasattr(_aruco, name):
        raise ConfigError(f"scale.marker_dictionary {name}: unknown; OpenCV has {', '.join(DICTIONARIES)} and others")
    parameters = _aruco.DetectorParameters()
    parameters.cornerRefinementMethod = _aruco.CORNER_REFINE_SUBPIX
    return _aruco.ArucoDetector(_aruco.getPredefinedDictionary(getattr(_aruco, name)), parameters)


def _markers(detector: Any, image: UInt8) -> list[tuple[int, Float64]]:
    corners, numbers, _ = detector.detectMarkers(image)
    if numbers is None:
        return []
    return [
        (int(number), np.asarray(four, np.float64).reshape(4, 2))
        for number, four in zip(np.ravel(numbers), corners, strict=True)
    ]


def _image(sequence: Sequence, row: int) -> UInt8 | None:
    try:
        return sequence[row].image
    except InputError:
        return None
