"""The verdicts of a run as its run.json has them: which frames are in doubt, and lines for a person."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from improvo.odometry.verdict.verdict import DOUBTFUL, NOT_JUDGED
from improvo.types import Int64, Mask


def verdict_of(segment: Mapping[str, Any]) -> dict[str, Any]:
    """The verdict in a segment of run.json; `not judged` in one that was written before there were verdicts."""
    if "verdict" not in segment:
        return {"word": NOT_JUDGED, "error_percent": None, "noise_px": None, "evidence": [], "uncertain": []}
    return dict(segment["verdict"])


def doubtful_frames(report: Mapping[str, Any], segment: Int64) -> Mask:
    """(F,) frames whose segment is doubtful.

    Args:
        report: the content of run.json.
        segment: (F,) segment of each frame, -1 without a pose.
    """
    numbers = [each["number"] for each in report["segments"] if verdict_of(each)["word"] == DOUBTFUL]
    return np.isin(segment, numbers)


def uncertain_frames(report: Mapping[str, Any], frame_indices: Int64) -> Mask:
    """(N,) frames within a stretch whose scale is not determined.

    Args:
        report: the content of run.json.
        frame_indices: (N,) of frames with a pose.
    """
    found = np.zeros(len(frame_indices), np.bool_)
    for each in report["segments"]:
        for first, last in verdict_of(each)["uncertain"]:
            found |= (frame_indices >= first) & (frame_indices <= last)
    return found


def verdict_lines(report: Mapping[str, Any], only: str | None = None) -> list[str]:
    """One line for each segment: its frames, the word, and why.

    Args:
        report: the content of run.json.
        only: this word; None: all of them.
    """
    lines = []
    for each in report["segments"]:
        verdict = verdict_of(each)
        if only not in (None, verdict["word"]):
            continue
        why = "; ".join(verdict["evidence"]) or "there is no verdict of it"
        frames = f"frames {each['first']} to {each['last']}"
        if each.get("frames", np.inf) < (each["last"] - each["first"] + 1) / 2:  # others lie between
            frames = f"{each['frames']} of {frames}"
        lines.append(f"segment {each['number']} ({frames}) is {verdict['word']}: {why}")
    return lines


def what_doubt_means(report: Mapping[str, Any]) -> list[str]:
    """What a person can do about doubtful segments, a line each; none where there is no such segment.

    Args:
        report: the content of run.json.
    """
    doubted = verdict_lines(report, only=DOUBTFUL)
    if not doubted:
        return []
    lines = ["what is doubtful may be wrong, and makes no labels; look at it before you use it"]
    if any("a camera that only turns" in line for line in doubted):
        lines.append("find out how wide the lens sees (`improvo calibrate`), and give that by --camera or --fov")
    if any("the focal length" in line for line in doubted):
        lines.append(
            "if the lens zoomed, cut the recording there and give each part its own camera; if not, calibrate "
            "(`improvo calibrate`), or leave out what moves (`--mask`)"
        )
    return lines
