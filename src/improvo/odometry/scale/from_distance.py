"""Scale by known distances between the camera's places at two frames each."""

from __future__ import annotations

from collections.abc import Sequence as List
from dataclasses import dataclass

import numpy as np

from improvo.errors import InputError
from improvo.geometry.alignment import path_length
from improvo.odometry.scale.estimate import ScaleEstimate
from improvo.odometry.scale.settings import ScaleSettings
from improvo.odometry.scale.tracked import TrackedRun
from improvo.sequences import Sequence

_DRIFT = 0.01  # of the way between the frames, as odometry usually has it
_MOST_ERROR = 0.3  # of the distance, by that drift
_TAPE = 0.01  # of a distance, as a person measures it
_CONTRADICTS = 3.0  # standard errors between two distances, beyond which one of them is wrong


@dataclass(frozen=True)
class _Measured:
    """What one distance says."""

    frames: tuple[int, int]  # numbers in the recording
    factor: float  # metres a unit
    error: float  # relative, by the odometry's drift


def check_frames(sequence: Sequence, settings: ScaleSettings) -> None:
    """Refuse frames that are not part of the sequence, before any work.

    Raises:
        InputError: one of them is not.
    """
    for first, last, _ in settings.distances:
        for frame in (first, last):
            if frame not in sequence.indices:
                raise InputError(
                    f"--scale distance: frame {frame} is not among those that are read ({sequence.indices[0]} to "
                    f"{sequence.indices[-1]}, every {sequence.settings.stride}); numbers are those of the recording"
                )


def scale_from_distance(run: TrackedRun, settings: ScaleSettings) -> dict[int, ScaleEstimate]:
    """Of each segment that both frames of a distance belong to; several distances of one segment are averaged.

    Raises:
        InputError: a frame without a pose, two segments, two places too near to each other for the way between, or
            distances that contradict each other.
    """
    measured: dict[int, list[_Measured]] = {}
    for first, last, metres in settings.distances:
        segment, one = _measured(run, first, last, metres)
        measured.setdefault(segment, []).append(one)
    return {segment: _together(measured[segment]) for segment in sorted(measured)}


def _measured(run: TrackedRun, first: int, last: int, metres: float) -> tuple[int, _Measured]:
    """The segment of a distance, and what it says."""
    rows = []
    for number in (first, last):
        found = np.flatnonzero(run.source_index == number)
        if len(found) == 0 or not run.trajectory.valid[found[0]]:
            raise InputError(f"--scale distance: frame {number} has no pose; take frames that have one (run.json)")
        rows.append(int(found[0]))
    low, high = sorted(rows)
    segment = run.trajectory.segment[[low, high]]
    if segment[0] != segment[1]:
        raise InputError(
            f"--scale distance: tracking began anew between frames {first} and {last}, so that they share no scale; "
            "take two frames of one segment (run.json)"
        )
    between = run.frames(int(segment[0]))
    centres = run.trajectory.camera_centers[between[(between >= low) & (between <= high)]]
    way = path_length(centres)
    distance = float(np.linalg.norm(centres[-1] - centres[0]))
    if distance <= 0 or _DRIFT * way > _MOST_ERROR * distance:
        raise InputError(
            f"--scale distance: the camera is at nearly the same place in frames {first} and {last}, for the way "
            "between them; take two that lie further apart"
        )
    return int(segment[0]), _Measured((first, last), metres / distance, _DRIFT * way / distance)


def _together(measured: List[_Measured]) -> ScaleEstimate:
    """One scale from the distances of a segment, the surer ones counting more.

    Raises:
        InputError: two of them differ by more than drift and tape explain.
    """
    if len(measured) == 1:
        return ScaleEstimate(measured[0].factor, measured[0].error, 1)
    logs, errors = np.log([each.factor for each in measured]), np.array([each.error for each in measured])
    variance = errors**2 + _TAPE**2
    apart = np.abs(logs[:, None] - logs) / np.sqrt(variance[:, None] + variance)
    one, other = sorted(divmod(int(apart.argmax()), len(measured)))
    if apart[one, other] > _CONTRADICTS:
        a, b = measured[one], measured[other]
        raise InputError(
            f"--scale distance: frames {a.frames[0]} and {a.frames[1]} give {a.factor:.4g} m a unit, frames "
            f"{b.frames[0]} and {b.frames[1]} give {b.factor:.4g} m, {_apart(b.factor / a.factor)} apart; "
            "measure again, or leave one out"
        )
    weights = 1 / variance
    mean = float(np.average(logs, weights=weights))
    expected = 1 / np.sqrt(weights.sum())
    # what they really differ by counts where it is more than expected
    excess = np.sqrt(np.average((logs - mean) ** 2, weights=weights) / (len(measured) - 1))
    return ScaleEstimate(float(np.exp(mean)), float(max(expected, excess)), len(measured))


def _apart(ratio: float) -> str:
    """How far one scale is from another, in words."""
    larger = max(ratio, 1 / ratio)
    return f"a factor of {larger:.3g}" if larger >= 2 else f"{100 * abs(ratio - 1):.2g} %"
