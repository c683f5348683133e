"""Problems of a recording, and what to do about them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from improvo.sequences.sequence import Sequence

DARK, BRIGHT = 30, 225  # median grey levels
FEW_CORNERS = 60
STILL_SHARE = 0.003  # of the picture
_FIELDS = (8.0, 150.0)  # degrees; lenses outside are rare, and slips common
_OFF_CENTRE = 0.2  # of the picture's side
_ASPECT = 1.15  # between fx and fy


@dataclass(frozen=True)
class Problem:
    """A problem, and what to do about it."""

    what: str
    advice: str


def camera_problems(sequence: Sequence) -> list[Problem]:
    """Camera parameters that are possible but not plausible."""
    raw = sequence.raw_camera
    mend = "compare the calibration with the pictures: is it of this camera, at this size and zoom?"
    found = []
    field = float(2 * np.degrees(np.arctan(0.5 * max(raw.width / raw.fx, raw.height / raw.fy))))
    if raw.distortion_model == "brown" and not _FIELDS[0] <= field <= _FIELDS[1]:
        found.append(Problem(f"the camera sees {field:.3g} degrees, which few lenses do", mend))
    off = max(abs(raw.cx - (raw.width - 1) / 2) / raw.width, abs(raw.cy - (raw.height - 1) / 2) / raw.height)
    if off > _OFF_CENTRE:
        found.append(
            Problem(
                f"the principal point ({raw.cx:.6g}, {raw.cy:.6g}) is {100 * off:.0f} % of a side from the middle "
                f"of the {raw.width}x{raw.height} picture",
                mend,
            )
        )
    if max(raw.fx / raw.fy, raw.fy / raw.fx) > _ASPECT:
        found.append(Problem(f"fx {raw.fx:.6g} and fy {raw.fy:.6g} differ, as if pixels were not square", mend))
    return found


def picture_problems(facts: dict[str, Any]) -> list[Problem]:
    """Problems in the sampled pictures, the worst first."""
    found = []
    if facts["unreadable"]:
        found.append(
            Problem(
                f"{len(facts['unreadable'])} of {facts['sampled'] + len(facts['unreadable'])} sampled frames cannot be "
                f"read, first {facts['unreadable'][0]}: {facts['unreadable_because']}",
                "they are skipped; if they are many, copy or convert the recording again, all pictures in one size",
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
    if facts["still"] > STILL_SHARE:
        found.append(
            Problem(
                f"{100 * facts['still']:.1f} % of the picture never changes while the rest does (an overlay, a border, "
                "or a part of what carries the camera)",
                "points there stand still and pull the poses with them; `improvo info SEQUENCE --write-mask mask.png` "
                "writes a mask of it, and every command leaves it out with --mask mask.png",
            )
        )
    if facts["corners"] < FEW_CORNERS:
        found.append(
            Problem(
                f"there is little texture (about {facts['corners']} corners a frame)",
                "point the camera at structured surfaces; --max-keypoints higher and a learned frontend help",
            )
        )
    if facts["corners"] == 0 and found:
        return found  # in pictures without content, the other measurements mean nothing
    if facts["blurred"] > 0.15:
        found.append(
            Problem(
                f"{100 * facts['blurred']:.0f} % of the frames are blurred against the sharpest",
                "move slower, add light, or shorten the exposure",
            )
        )
    if facts["duplicates"] > 0.05:
        found.append(
            Problem(
                f"{100 * facts['duplicates']:.0f} % of neighbouring frames show the same picture: frames are repeated, "
                "or the camera hardly moves",
                "harmless but slow; " + _fewer_frames(facts["duplicates"]),
            )
        )
    return found


def _fewer_frames(duplicates: float) -> str:
    """How to leave frames out of which this share equals the one before."""
    if duplicates < 0.6:  # each picture twice is a half
        return "--stride 2 leaves most of them out"
    return "a --stride leaves most of them out, larger where the camera moves more slowly"
