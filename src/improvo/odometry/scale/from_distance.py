"""Scale by a known distance between the camera's places at two frames."""

from __future__ import annotations

import numpy as np

from improvo.errors import InputError
from improvo.odometry.scale.estimate import ScaleEstimate
from improvo.odometry.scale.settings import ScaleSettings
from improvo.odometry.scale.tracked import TrackedRun
from improvo.sequences import Sequence

_DRIFT = 0.01  # of the way between the frames, as odometry usually has it
_MOST_ERROR = 0.3  # of the distance, by that drift


def check_frames(sequence: Sequence, settings: ScaleSettings) -> None:
    """Refuse frames that are not part of the sequence, before any work.

    Raises:
        InputError: one of them is not.
    """
    assert settings.frames is not None
    for frame in settings.frames:
        if frame not in sequence.indices:
            raise InputError(
                f"--scale distance: frame {frame} is not among those that are read ({sequence.indices[0]} to "
                f"{sequence.indices[-1]}, every {sequence.settings.stride}); numbers are those of the recording"
            )


def scale_from_distance(run: TrackedRun, settings: ScaleSettings) -> dict[int, ScaleEstimate]:
    """Of the segment that both frames belong to.

    Raises:
        InputError: a frame without a pose, two segments, or two places too near to each other for the way between.
    """
    assert settings.frames is not None
    assert settings.metres is not None
    rows = []
    for number in settings.frames:
        found = np.flatnonzero(run.source_index == number)
        if len(found) == 0 or not run.trajectory.valid[found[0]]:
            raise InputError(f"--scale distance: frame {number} has no pose; take frames that have one (run.json)")
        rows.append(int(found[0]))
    first, last = sorted(rows)
    segment = run.trajectory.segment[[first, last]]
    if segment[0] != segment[1]:
        raise InputError(
            f"--scale distance: tracking began anew between frames {settings.frames[0]} and {settings.frames[1]}, so "
            "that they share no scale; take two frames of one segment (run.json)"
        )
    between = run.frames(int(segment[0]))
    centres = run.trajectory.camera_centers[between[(between >= first) & (between <= last)]]
    way = float(np.linalg.norm(np.diff(centres, axis=0), axis=1).sum())
    distance = float(np.linalg.norm(centres[-1] - centres[0]))
    if distance <= 0 or _DRIFT * way > _MOST_ERROR * distance:
        raise InputError(
            f"--scale distance: the camera is at nearly the same place in frames {settings.frames[0]} and "
            f"{settings.frames[1]}, for the way between them; take two that lie further apart"
        )
    return {int(segment[0]): ScaleEstimate(settings.metres / distance, _DRIFT * way / distance, 1)}
