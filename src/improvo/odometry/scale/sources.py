"""The sources of scale: each is looked for before a run begins, and asked when it is over."""

from __future__ import annotations

from collections.abc import Callable

from improvo.errors import InputError
from improvo.odometry.scale.estimate import ScaleEstimate
from improvo.odometry.scale.from_depth import check_depth, scale_from_depth
from improvo.odometry.scale.from_distance import check_frames, scale_from_distance
from improvo.odometry.scale.from_height import scale_from_height
from improvo.odometry.scale.from_marker import find_markers, scale_from_marker
from improvo.odometry.scale.from_truth import reference_of, scale_from_truth
from improvo.odometry.scale.settings import ScaleSettings
from improvo.odometry.scale.tracked import TrackedRun
from improvo.sequences import Sequence

Ask = Callable[[TrackedRun], dict[int, ScaleEstimate]]


def scale_source(
    sequence: Sequence, settings: ScaleSettings, progress: Callable[[int], object] = lambda _: None
) -> Ask | None:
    """What gives the scale of each segment of a finished run; None where none is asked for.

    Args:
        sequence: is looked at now, so that a source that is not there is known before any work.
        settings: which source.
        progress: called with 1 for each frame that is looked at.

    Raises:
        InputError: the recording has no such source, or is live and would have to be read twice.
    """
    if settings.source == "none":
        return None
    if sequence.length is None:
        raise InputError(f"--scale {settings.source}: {sequence.path} is live; record it first")
    if settings.source == "depth":
        check_depth(sequence)
        return scale_from_depth
    if settings.source == "truth":
        reference = reference_of(sequence, settings)
        return lambda run: scale_from_truth(run, reference)
    if settings.source == "distance":
        check_frames(sequence, settings)
        return lambda run: scale_from_distance(run, settings)
    if settings.source == "height":
        return lambda run: scale_from_height(run, settings)
    markers = find_markers(sequence, settings, progress)
    return lambda run: scale_from_marker(run, markers, settings)
