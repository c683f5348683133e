"""What a recording is and what is wrong with it, from its headers and a sample of its frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from improvo.errors import InputError
from improvo.geometry.alignment import path_length
from improvo.sequences.base import SequenceSettings
from improvo.sequences.live import LiveStream
from improvo.sequences.opening import open_recording
from improvo.sequences.rates import given_calibration
from improvo.sequences.sequence import Sequence
from improvo.sequences.survey_judgement import Problem, camera_problems, picture_problems
from improvo.sequences.survey_pictures import measure
from improvo.terminal import counted

PLACEHOLDER_FOV = 60.0
GAP_STEPS = 2.5  # median time steps
RATES = (0.05, 1000.0)  # frames per second; outside this range time stamps are probably not in seconds


@dataclass(frozen=True)
class Survey:
    """The findings, as plain values ready for JSON (`facts`), and the problems."""

    facts: dict[str, Any]
    problems: tuple[Problem, ...]

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {**self.facts, "problems": [{"what": p.what, "advice": p.advice} for p in self.problems]}


def survey(
    path: Any, settings: SequenceSettings, samples: int = 120, progress: Callable[[int], object] = lambda _: None
) -> Survey:
    """Look at a recording.

    Args:
        path: as for `open_sequence`.
        settings: how it is read; a missing or wrong calibration is reported, not raised.
        samples: pairs of neighbouring frames to decode, spread over the recording.
        progress: called with 1 for each pair.

    Raises:
        InputError: it cannot be opened at all, is live, or `settings.camera` is no calibration.
    """
    recording = open_recording(path, settings)
    if isinstance(recording, LiveStream):
        recording.close()
        raise InputError(f"{path}: is live, so there is nothing to look at yet; record it first")
    given_calibration(settings, recording.path)  # a calibration given by the user must be correct
    problems: list[Problem] = []
    calibrated = True
    try:
        sequence = Sequence(recording, settings)
    except InputError as error:
        try:
            sequence = Sequence(recording, replace(settings, camera=None, fov=PLACEHOLDER_FOV))
        except InputError:
            raise error from None
        calibrated = False
        problems.append(
            Problem(
                str(error), "`improvo calibrate VIDEO` finds the camera from the motion, or more exactly with `--board`"
            )
        )
    measured = measure(sequence, samples, progress)
    facts: dict[str, Any] = {
        "name": sequence.name,
        "path": str(sequence.path),
        "format": sequence.format,
        "frames": len(sequence),
        **_timing(sequence, problems),
        "size": [sequence.raw_camera.width, sequence.raw_camera.height],
        "camera": _camera(sequence) if calibrated else None,
        "depth": measured.pop("depth"),
        "ground_truth": _truth(sequence, problems),
        **measured,
        "unreadable": [skip.source for skip in sequence.skipped],
        "unreadable_because": sequence.skipped[0].reason if sequence.skipped else None,
        "notes": list(sequence.notes if calibrated else (*recording.notes, *sequence.absent)),
    }
    problems += camera_problems(sequence) if calibrated else []
    problems += picture_problems(facts)
    return Survey(facts, tuple(problems))


def _camera(sequence: Sequence) -> dict[str, Any]:
    raw = sequence.raw_camera
    fov = 2 * np.degrees(np.arctan(0.5 * sequence.camera.width / sequence.camera.fx))
    return {
        "fx": raw.fx,
        "fy": raw.fy,
        "cx": raw.cx,
        "cy": raw.cy,
        "distortion_model": raw.distortion_model,
        "distortion": list(raw.distortion),
        "view": sequence.view,
        "horizontal_fov_deg": round(float(fov), 1),
    }


def _timing(sequence: Sequence, problems: list[Problem]) -> dict[str, Any]:
    """Rate, duration and gaps, from the time stamps of all frames."""
    steps = np.diff(sequence.times)
    if len(steps) == 0:
        return {"frames_per_second": None, "seconds": 0.0, "gaps": []}
    median = float(np.median(steps))
    rows = np.flatnonzero(steps > GAP_STEPS * median)
    gaps = [{"after_frame": int(sequence.indices[r]), "seconds": round(float(steps[r]), 6)} for r in rows]
    if gaps:
        longest = max(gaps, key=lambda gap: float(gap["seconds"]))
        problems.append(
            Problem(
                f"{counted(len(gaps), 'gap')} in the time stamps, the longest {longest['seconds']:.3g} s after frame "
                f"{longest['after_frame']}",
                "tracking may be lost there; cut the recording with --start and --end, or record without interruption",
            )
        )
    duration = float(sequence.times[-1] - sequence.times[0])
    if not RATES[0] <= 1 / median <= RATES[1]:
        problems.insert(
            0,
            Problem(
                f"{1 / median:.3g} frames per second over {duration:.6g} s is not plausible, so the time stamps are "
                "hardly seconds",
                "give the true rate with --fps, or write the time stamps in seconds",
            ),
        )
    return {"frames_per_second": round(1 / median, 4), "seconds": round(duration, 6), "gaps": gaps}


def _truth(sequence: Sequence, problems: list[Problem]) -> dict[str, Any] | None:
    truth = sequence.ground_truth
    if truth is None:
        return None
    valid = int(truth.valid.sum())
    if valid == 0 and sequence.recording.ground_truth is not None:
        own = sequence.recording.ground_truth.times
        problems.append(
            Problem(
                f"no frame has ground truth: frames are from {sequence.times[0]:.3f} to {sequence.times[-1]:.3f} s, "
                f"ground truth from {own[0]:.3f} to {own[-1]:.3f} s",
                "bring both to one clock, in seconds",
            )
        )
    elif valid < len(truth):
        problems.append(
            Problem(
                f"{len(truth) - valid} of {len(truth)} frames have no ground truth",
                "evaluation leaves them out",
            )
        )
    return {"poses": valid, "path_length": round(path_length(truth.camera_centers[truth.valid]), 4)}
