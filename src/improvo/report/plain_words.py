"""Warnings about a run, in plain words, from `run.json`."""

from __future__ import annotations

from typing import Any

import numpy as np

from improvo.odometry.verdict.told_verdicts import verdict_lines, what_doubt_means
from improvo.odometry.verdict.verdict import DOUBTFUL
from improvo.types import Float64, Int64

LABEL_WORDS = (
    "Ignore: too short, or in between stable and unstable, so it teaches nothing. Withheld: it had a label, which the "
    "quality gate took away, because the odometry is not to be trusted where the track was seen."
)
_TOLD = 5  # events of a kind that have a line of their own
_DARK = 25.0  # mean grey value below which keypoints become rare


def warnings(report: dict[str, Any], shown: Int64, brightness: Float64, median_error: float) -> list[str]:
    """One line for each problem or doubt, the most serious first.

    Args:
        report: the content of run.json.
        shown: (N,) frames whose brightness is known.
        brightness: (N,) mean grey value.
        median_error: pixels, over all observations; NaN without any.
    """
    lines = []
    frames, segments = report["frames"], report["segments"]
    if report["interrupted"]:
        lines.append(f"The run was interrupted after {frames['processed']} frames; it is complete up to there.")
    if frames["tracked"] == 0:
        lines.append(
            "No frame has a pose: the camera moved too little, only turned, or saw too little texture. Move sideways."
        )
    doubts = [*verdict_lines(report, only=DOUBTFUL), *what_doubt_means(report)]
    lines += [f"{line[0].upper()}{line[1:]}." for line in doubts]
    lines += _events(report)
    if frames["lost"]:
        lines.append(f"{frames['lost']} of {frames['processed']} frames have no pose: {ranges(frames['lost_frames'])}.")
    if len(segments) > 1:
        starts = ", ".join(str(segment["first"]) for segment in segments[1:])
        lines.append(
            f"The trajectory is in {len(segments)} segments (new ones start at frames {starts}). Each has its own "
            "scale, and where they stand to each other is a guess."
        )
    skipped = report["input"]["skipped"]
    if skipped:
        first = skipped[0]
        lines.append(f"{len(skipped)} frames could not be read, the first is {first['source']}: {first['reason']}.")
    lines += [f"About the recording: {note}." for note in report["input"]["notes"]]
    dark = shown[brightness < _DARK]
    if len(dark):
        lines.append(f"Dark frames (mean grey value under {_DARK:g} of 255): {ranges(dark.tolist())}.")
    if np.isfinite(median_error) and median_error > 1.5:
        lines.append(
            f"The median re-projection error is {median_error:.1f} px; 0.2 to 1 is usual. Check the calibration "
            "(`improvo info`), rolling shutter and blur."
        )
    return lines


def _events(report: dict[str, Any]) -> list[str]:
    lines = []
    by_kind: dict[str, list[dict[str, Any]]] = {}
    for event in report["events"]:
        by_kind.setdefault(event["kind"], []).append(event)
    for kind, word in (("lost", "Lost"), ("contradiction", "Doubtful")):
        told = by_kind.pop(kind, [])
        lines += [f"{word} at frame {event['frame_index']}: {event['detail']}." for event in told[:_TOLD]]
        if len(told) > _TOLD:
            more = ranges([event["frame_index"] for event in told[_TOLD:]])
            lines.append(f"{word} {len(told) - _TOLD} times more, at frames {more}.")
    waiting = by_kind.pop("initialising", [])
    if waiting and report["frames"]["lost"]:  # frames that only waited get their pose once the map has begun
        last = waiting[-1]
        lines.append(f"The map could not begin; the last reason, at frame {last['frame_index']}: {last['detail']}.")
    for kind in ("segment", "doubtful", "withdrawn"):  # said by the number of segments, and by their verdicts
        by_kind.pop(kind, None)
    for kind, events in by_kind.items():
        lines.append(f"{kind.capitalize()} at frame {events[0]['frame_index']}: {events[0]['detail']}.")
    return lines


def ranges(numbers: list[int]) -> str:
    """`3, 7-9, 12`, at most eight parts."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][1] + 1:
            parts[-1][1] = number
        else:
            parts.append([number, number])
    words = [str(first) if first == last else f"{first}-{last}" for first, last in parts]
    return ", ".join(words[:8]) + (f" and {len(words) - 8} more stretches" if len(words) > 8 else "")
