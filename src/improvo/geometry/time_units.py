"""Time stamps in seconds, whatever unit they were written in: seconds, milliseconds, microseconds or nanoseconds.

The unit is told by size. A date between 1990 and 2100 fits one unit only, unless stamps count from another start: 2
seconds in nanoseconds look like 2033 in seconds, but then a step between frames would be over an hour. Stamps from
another start are whole numbers in units other than seconds, and the step between frames tells which. A step of 5 to 400
is that of a video in milliseconds, or of a time lapse in whole seconds: it is read as the first, and a note says so.
"""

from __future__ import annotations

import numpy as np

from improvo.types import Float64

UNITS = {"seconds": 1.0, "milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}
_DATES = (6.3e8, 4.2e9)  # seconds since 1970: 1990 to 2100
# the smallest median step of whole numbers that is read as this unit
_STEPS = (("nanoseconds", 4e6), ("microseconds", 4e3), ("milliseconds", 400.0))
_VIDEO_STEP = 5.0  # milliseconds: 200 frames a second
_LONGEST_STEP = 4e3  # seconds; whole numbers that are dates so far apart are none


def in_seconds(stamps: Float64, of_video: bool = True) -> tuple[Float64, str | None]:
    """Stamps (N,) in seconds, and the name of their unit where it was another; `of_video` as for `unit_of`."""
    unit = unit_of(stamps, of_video)
    return (stamps, None) if unit == "seconds" else (stamps / UNITS[unit], unit)


def note_of(unit: str) -> str:
    """What a person is told about stamps that were in this unit."""
    unsure = "; if they are seconds, as of a time lapse, write one of them with a fraction, such as 0.001"
    return f"time stamps are taken as {unit}, by their size{unsure if unit == 'milliseconds' else ''}"


def unit_of(stamps: Float64, of_video: bool = True) -> str:
    """The unit that stamps (N,) are in, by their size; `seconds` where nothing speaks against it.

    Args:
        stamps: (N,).
        of_video: whether frames were taken then, 2.5 a second or more. Without it, whole numbers less than 400 apart
            are seconds: places of a GPS receiver, or a count.
    """
    finite = stamps[np.isfinite(stamps)]
    if len(finite) == 0:
        return "seconds"
    middle = float(np.median(finite))
    steps = np.diff(np.unique(finite))
    whole = len(steps) > 0 and not (finite != np.rint(finite)).any()
    step = float(np.median(steps)) if whole else 0.0
    for unit, scale in UNITS.items():
        if _DATES[0] <= middle / scale <= _DATES[1] and step < _LONGEST_STEP * scale:
            return unit
    if not whole:
        return "seconds"
    if of_video and _VIDEO_STEP <= step <= _STEPS[-1][1]:
        return "milliseconds"
    return next((unit for unit, least in _STEPS if step >= least), "seconds")
