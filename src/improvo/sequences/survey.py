"""What a recording is and what is wrong with it, from its headers and a sample of its frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from improvo.errors import InputError
from improvo.sequences.base import SequenceSettings
from improvo.sequences.live import LiveStream
from improvo.sequences.opening import open_recording
from improvo.sequences.sequence import Sequence
from improvo.types import Float64, UInt8

PLACEHOLDER_FOV = 60.0
DUPLICATE_LEVELS = 0.6  # mean grey levels between neighbours at 160 pixels width: less is the same picture again
GAP_STEPS = 2.5  # median time steps
BLUR_SHARE = 0.5  # of the recording's own sharpness
DARK, BRIGHT = 30, 225  # median grey levels
CLIPPED = (5, 250)  # grey levels
FEW_CORNERS = 60
_WORK_WIDTH = 320
_DUPLICATE_WIDTH = 160


@dataclass(frozen=True)
class Problem:
    """Something to mend, and how."""

    what: str
    advice: str


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
        InputError: it cannot be opened at all, or is live.
    """
    recording = open_recording(path, settings)
    if isinstance(recording, LiveStream):
        recording.close()
        raise InputError(f"{path}: is live, so there is nothing to look at yet; record it first")
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
        problems.append(Problem(str(error), "`improvo calibrate VIDEO_OF_A_BOARD` makes a camera.yaml in a minute"))
    measured = _measure(sequence, samples, progress)
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
        "notes": list(sequence.notes),
    }
    problems += _judge(facts)
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
                f"{len(gaps)} gaps in the time stamps, the longest {longest['seconds']:.3g} s after frame "
                f"{longest['after_frame']}",
                "tracking may be lost there; cut the recording with --start and --end, or record without interruption",
            )
        )
    duration = float(sequence.times[-1] - sequence.times[0])
    return {"frames_per_second": round(1 / median, 4), "seconds": round(duration, 6), "gaps": gaps}


def _truth(sequence: Sequence, problems: list[Problem]) -> dict[str, Any] | None:
    truth = sequence.ground_truth
    if truth is None:
        return None
    valid = int(truth.valid.sum())
    if valid < len(truth):
        problems.append(
            Problem(
                f"{len(truth) - valid} of {len(truth)} frames have no ground truth",
                "evaluation leaves them out; if it is all of them, compare the two clocks",
            )
        )
    path = float(np.linalg.norm(np.diff(truth.camera_centers[truth.valid], axis=0), axis=1).sum())
    return {"poses": valid, "path_length": round(path, 4)}


def _measure(sequence: Sequence, samples: int, progress: Callable[[int], object]) -> dict[str, Any]:
    """Blur, exposure, texture and repetition, from pairs of neighbouring frames."""
    starts = np.unique(np.linspace(0, max(0, len(sequence) - 2), min(samples, max(1, len(sequence) - 1))).astype(int))
    rows: list[Float64] = []
    duplicates, pairs, with_depth, depth_median = 0, 0, 0, []
    previous: tuple[int, UInt8] | None = None
    for start in starts.tolist():
        pair = []
        for row in (start, start + 1)[: len(sequence)]:
            if previous is not None and previous[0] == row:
                pair.append(previous[1])
                continue
            image = _try(sequence, row)
            if image is not None:
                rows.append(_look(image))
                pair.append(image)
                previous = (row, image)
        if len(pair) == 2:
            pairs += 1
            duplicates += bool(_difference(pair[0], pair[1]) < DUPLICATE_LEVELS)
        depth = sequence.depth(start)
        if depth is not None:
            with_depth += 1
            depth_median.append(float(np.nanmedian(depth)) if np.isfinite(depth).any() else np.nan)
        progress(1)
    looks = np.stack(rows) if rows else np.zeros((1, 4))
    sharp = float(np.percentile(looks[:, 0], 90))
    depth_facts = None
    if with_depth:
        median = float(np.nanmedian(depth_median)) if np.isfinite(depth_median).any() else None
        depth_facts = {"share_of_frames": round(with_depth / len(starts), 3), "median": median}
    return {
        "sampled": len(rows),
        "duplicates": round(duplicates / pairs, 3) if pairs else 0.0,
        "blurred": round(float((looks[:, 0] < BLUR_SHARE * sharp).mean()), 3) if sharp > 0 else 1.0,
        "brightness": round(float(np.median(looks[:, 1])), 1),
        "clipped": round(float(looks[:, 2].mean()), 3),
        "corners": int(np.median(looks[:, 3])),
        "depth": depth_facts,
    }


def _try(sequence: Sequence, row: int) -> UInt8 | None:
    try:
        return sequence[row].image
    except InputError:
        return None


def _look(image: UInt8) -> Float64:
    """Sharpness (second over first derivatives, so that little texture is not blur), median, share clipped, corners."""
    width = min(_WORK_WIDTH, image.shape[1])
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    # kernels of 5 pixels, under which the rounding to grey levels does not count as detail
    across, down = (cv2.Sobel(small, cv2.CV_32F, *order, ksize=5) for order in ((1, 0), (0, 1)))
    gradient = float(np.sqrt((across**2 + down**2).mean()))
    sharpness = float(cv2.Laplacian(small, cv2.CV_32F, ksize=5).std()) / (gradient + 1.0)
    clipped = float(((small <= CLIPPED[0]) | (small >= CLIPPED[1])).mean())
    corners = cv2.goodFeaturesToTrack(small, 500, 0.01, 5, blockSize=5)
    strong = 0 if corners is None or small.std() < 2 else len(corners)
    return np.array([sharpness, np.median(small), clipped, strong], np.float64)


def _difference(a: UInt8, b: UInt8) -> float:
    height = max(1, round(a.shape[0] * _DUPLICATE_WIDTH / a.shape[1]))
    small = [cv2.resize(image, (_DUPLICATE_WIDTH, height), interpolation=cv2.INTER_AREA) for image in (a, b)]
    return float(cv2.absdiff(small[0], small[1]).mean())


def _judge(facts: dict[str, Any]) -> list[Problem]:
    """What in the sampled frames will hurt, and what to do about it."""
    found = []
    if facts["unreadable"]:
        found.append(
            Problem(
                f"{len(facts['unreadable'])} of {facts['sampled'] + len(facts['unreadable'])} sampled frames cannot be "
                f"read, first {facts['unreadable'][0]}",
                "they are skipped; copy or convert the recording again if they are many",
            )
        )
    if facts["duplicates"] > 0.05:
        found.append(
            Problem(
                f"{100 * facts['duplicates']:.0f} % of neighbouring frames show the same picture",
                "harmless but slow; --stride 2 leaves most of them out",
            )
        )
    if facts["blurred"] > 0.15:
        found.append(
            Problem(
                f"{100 * facts['blurred']:.0f} % of the frames are blurred against the sharpest",
                "move slower, add light, or shorten the exposure",
            )
        )
    if not DARK <= facts["brightness"] <= BRIGHT:
        dark = facts["brightness"] < DARK
        found.append(
            Problem(
                f"the picture is very {'dark' if dark else 'bright'} (median grey {facts['brightness']:.0f} of 255)",
                "add light or lengthen the exposure" if dark else "shorten the exposure",
            )
        )
    if facts["clipped"] > 0.2:
        found.append(
            Problem(
                f"{100 * facts['clipped']:.0f} % of the pixels are black or white",
                "set the exposure by hand, and keep windows and lamps out of the picture",
            )
        )
    if facts["corners"] < FEW_CORNERS:
        found.append(
            Problem(
                f"there is little texture (about {facts['corners']} corners a frame)",
                "point the camera at structured surfaces; --max-keypoints higher and a learned frontend help",
            )
        )
    return found
