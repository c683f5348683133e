"""The keys of one camera in a file: read by any of their names, and none that matters left unread."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable, Iterator
from typing import Any

from improvo.geometry.camera_files.distortion import normalised

# what has to do with lens or size; a key like this that nobody read may not be dropped
_MATTERS = re.compile(
    r"dist|lens|fisheye|coef|radial|tangent|model|skew|prism|tilt|mirror|projection(type|model)|undistort|rectif"
    r"|^(k|p|s|t|r|tau|b)\d$|^tau[xy]$|^(xi|alpha|beta|omega|gamma\d?|kc|kappa\d?|shear|affinity)$"
    r"|^(im(age)?|img|pic(ture)?|frame|cam(era)?|orig(inal)?|calib(ration)?|sensor)?"
    r"(width|height|size|resolution|dimensions?|cols|rows)$|^(w|h)$|^[xy]?resolution[xy]?$"
    r"|binning|crop|^roi|stretch|squeeze|^scal(e|ing)(factor)?$"
)
# what looks like that and is not: boards, errors, names, other matrices, what a viewer or a map is drawn with
_HARMLESS = re.compile(
    r"board|square|marker|pattern|corner|grid|error|rms|std|deviation|uncertain|covar|viewer|window|queue|keyframe"
    r"|patch|cell|voxel|depth|baseline|bf$|rectif|projectionmatrix|^(r|p|q|t)$|imu|gyro|accel|noise|bias|timeoffset"
    r"|timeshift|rostopic|topic|comment|description|name|serial|vendor|brand|make$|note|firmware|version|flag"
    r"|^t(cam|imu|body|world|velo|lidar|base|robot|vehicle|ego)|t(cam|imu)\d?$|estimate|extrins|rotation|translat|transform|pose|^t(bs|camimu|cncnm1|ci|ic|sb|bc|cb)$|pixelsize|physical"
    r"|new(width|height)|output|target|shutter|lensposition|lensmodel$|lens(serial|make|info|spec)|focallengthmm|crop(edge|size)"
    r"|camoverlaps|distance|doruntimeundistort|^cmaes|^path|file"
)
_SURELY = re.compile(
    r"^(?!.*(error|rms|std|deviation|uncertain|covar|mask|undistort)).*(distor|distc|distp|fisheye|coef)"
)
_ONE_MEANS_NOTHING = re.compile(r"scal|stretch|squeeze|binning")
_KNOWN = (
    *("distortion", "distortioncoefficients", "distortioncoeffs", "distcoeffs", "distortionmodel", "cameramodel"),
    *("distortionparameters", "distortionparams", "imagewidth", "imageheight", "resolution", "width", "height"),
)


class Keys:
    """The `key: value` pairs of one camera. Names are compared without case, dots and underscores."""

    def __init__(self, values: Iterable[tuple[str, Any]]) -> None:
        self._values: dict[str, tuple[str, Any]] = {}
        self._read: set[str] = set()
        for key, value in values:
            if re.fullmatch(r"p\d", normalised(key)) and _is_projection(value):
                continue  # of a stereo pair; the coefficients p1 and p2 may stand beside it
            self._values[normalised(key)] = (str(key), value)

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def any_of(self, *names: str) -> str | None:
        """The first of these names that is there with a value."""
        return next((name for name in names if name in self._values and self._values[name][1] is not None), None)

    def original(self, name: str) -> str:
        """The key as the file spells it."""
        return self._values[name][0]

    def look(self, name: str) -> Any:
        """The value under a name, which does not count as read by this."""
        return self._values[name][1]

    def take(self, *names: str) -> Any:
        """The value under the first of these names, now read; None without any."""
        found = self.any_of(*names)
        if found is None:
            self._read.update(name for name in names if name in self._values)  # present, but without a value
            return None
        self._read.add(found)
        return self._values[found][1]

    def number(self, *names: str) -> float | None:
        """The number under the first of these names.

        Raises:
            ValueError: it is no number.
        """
        found = self.any_of(*names)
        value = self.take(*names)
        return None if value is None or found is None else number(value, self.original(found))

    def positive(self, *names: str) -> float | None:
        """The same, which must be above zero."""
        value = self.number(*names)
        if value is not None and not (math.isfinite(value) and value > 0):
            raise ValueError(f"{names[0]} {value:g} is not positive")
        return value

    def pass_over(self, *names: str) -> None:
        """Count these as read: they are known to mean nothing for the camera."""
        self._read.update(names)

    def forget(self, name: str) -> None:
        """Hide a key from all further readers; where it matters, it counts as unread."""
        self._read.discard(name)
        self._values[f"{name} "] = self._values.pop(name)

    def agree(self, values: dict[str, float]) -> None:
        """Refuse a file that also says another number under one of these names.

        Raises:
            ValueError: it contradicts itself.
        """
        for name, value in values.items():
            if name in self._values:
                other = self.number(name)
                if other is not None and abs(other - value) > 1e-6 * max(1.0, abs(value)):
                    raise ValueError(f"`{self.original(name)}` says {other:g}, and another key {value:g}; leave one")

    def unread_that_matter(self) -> Iterator[str]:
        """Keys that nobody read and that could be distortion, a model or a size."""
        for name, (original, value) in self._values.items():
            if name not in self._read and not _is_nothing(value) and _matters(name.strip(), value):
                yield original


def number(value: Any, key: str) -> float:
    """A number, also one that is written as a string.

    Raises:
        ValueError: anything else.
    """
    if isinstance(value, bool | list | tuple | dict):
        raise ValueError(f"`{key}` is no number but {value!r}"[:120])
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        comma = isinstance(value, str) and re.fullmatch(r"\s*[+-]?\d+,\d+(e[+-]?\d+)?\s*", value, re.IGNORECASE)
        hint = "; write a decimal point, not a comma" if comma else ""
        raise ValueError(f"`{key}` is no number but {value!r}"[:120] + hint) from None


def numbers(value: Any, key: str) -> tuple[float, ...]:
    """A flat list of numbers from a list, nested lists, a {rows, cols, data} matrix, or text with separators.

    Raises:
        ValueError: something in it is no number.
    """
    if value is None:
        return ()
    if isinstance(value, dict):
        value = value.get("data", value.get("Data"))
        if value is None:
            raise ValueError(f"`{key}` is no matrix: it has no `data`")
    if isinstance(value, str):
        value = re.split(r"[\s,;]+", value.strip().strip("[](){}").strip())
        value = [part for part in value if part]
    if not isinstance(value, list | tuple):
        return (number(value, key),)
    flat: list[float] = []
    for item in value:
        flat += numbers(item, key) if isinstance(item, list | tuple) else [number(item, key)]
    return tuple(flat)


def _is_projection(value: Any) -> bool:
    """Whether this is a matrix (3, 4)."""
    try:
        return isinstance(value, list | tuple | dict) and len(numbers(value, "")) == 12
    except ValueError:
        return False


def is_value(value: Any) -> bool:
    """Whether this is a leaf: a number, a text, a list of numbers, or a matrix."""
    if isinstance(value, dict):
        return "data" in value or "Data" in value
    if isinstance(value, list | tuple):
        return not any(isinstance(item, dict) for item in _leaves(value))
    return True


def _leaves(value: Any) -> Iterator[Any]:
    for item in value:
        if isinstance(item, list | tuple):
            yield from _leaves(item)
        else:
            yield item


def _matters(name: str, value: Any) -> bool:
    if _SURELY.search(name):
        return True
    if _HARMLESS.search(name) or (_ONE_MEANS_NOTHING.search(name) and value in (1, 1.0, "1", "1.0")):
        return False
    if re.fullmatch(r"[a-z]\d", name) and isinstance(value, list | tuple | dict):
        return False  # R1, P1, T1: matrices of a stereo pair
    if _MATTERS.search(name) or difflib.get_close_matches(name, _KNOWN, 1, 0.8):
        return True
    # a bare list of as many numbers as a lens has, under a name that says nothing
    try:
        return isinstance(value, list | tuple | dict) and len(numbers(value, name)) in (4, 5, 8, 12, 14)
    except ValueError:
        return False


def _is_nothing(value: Any) -> bool:
    """Whether a value says nothing: none, false, empty, or all zeros."""
    if value is None or value is False:
        return True
    if isinstance(value, str):
        return value.strip().lower() in ("", "none", "null", "false", "0", "0.0")
    try:
        return not any(numbers(value, ""))
    except ValueError:
        return False
