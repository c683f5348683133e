"""The cameras in a tree of keys, wherever a tool puts them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from improvo.errors import InputError
from improvo.geometry.camera_files.calibration import Calibration, checked
from improvo.geometry.camera_files.distortion import normalised
from improvo.geometry.camera_files.foreign import translated
from improvo.geometry.camera_files.keys import Keys, is_value
from improvo.geometry.camera_files.one_camera import has_intrinsics, one_camera

# groups of keys that belong to the camera above them
_PARTS = {
    *("intrinsics", "intrinsic", "intrinsicparameters", "projectionparameters", "distortionparameters", "distortion"),
    *("mirrorparameters", "fisheyeparams", "imagesize", "resolution", "size", "cameramatrix", "roi", "header"),
    *("distortioncoefficients", "distcoeffs", "principalpoint", "focallength", "calibdimension", "undistortion"),
}
_MAX_DEPTH = 12

Pairs = list[tuple[str, Any]]


def cameras(tree: Any, source: str, wanted: str | None) -> Calibration:
    """The calibration of the wanted camera of a file, of the first without; the others are its alternatives.

    Args:
        tree: nested mappings and lists, as YAML or JSON give them.
        source: the file, for messages.
        wanted: `cam1`, `Camera2`, `left`, or a number from 0; None is the first.

    Raises:
        KeyError: there is no camera, or an intrinsic is missing.
        ValueError: there is no such camera, or a value that cannot be.
    """
    found = list(_nodes(_undotted(translated(tree)), "", [], 0))
    if not found:
        flat = _flat(tree, "")
        raise KeyError(_missing({normalised(key.rsplit(".", 1)[-1]) for key, _ in flat}))
    if wanted is not None:
        chosen = [pairs for number, (name, pairs) in enumerate(found) if _is_called(name, number, wanted)]
        if not chosen:
            names = ", ".join(name or "0" for name, _ in found)
            raise ValueError(f"has no camera `{wanted}`; it has {names}")
        return checked(one_camera(Keys(chosen[0]), source))
    first = one_camera(Keys(found[0][1]), source)
    others = []
    for name, pairs in found[1:]:
        try:
            others.append(checked(one_camera(Keys(pairs), f"{source}#{name}")))
        except (KeyError, ValueError, InputError):  # noqa: PERF203 - only the camera that is used must be understood
            continue
    alternatives = tuple(other for other in others if other.size is not None)
    return checked(_with_alternatives(first, alternatives))


def _with_alternatives(first: Calibration, others: tuple[Calibration, ...]) -> Calibration:
    from dataclasses import replace

    return replace(first, alternatives=others) if first.size is not None else first


def _nodes(node: Any, name: str, inherited: Pairs, depth: int) -> Iterator[tuple[str, Pairs]]:
    """Name and key-value pairs of each camera, what stands above it among them."""
    if depth > _MAX_DEPTH:
        return
    if isinstance(node, list):
        for number, item in enumerate(node):
            if isinstance(item, dict | list):
                yield from _nodes(item, f"{name}.{number}" if name else str(number), inherited, depth + 1)
        return
    if not isinstance(node, dict):
        return
    own = [(str(key), value) for key, value in node.items() if is_value(value)]
    for key, value in node.items():
        if isinstance(value, dict) and not is_value(value) and normalised(key) in _PARTS:
            own += [(_named_in(normalised(key), k), v) for k, v in _flat(value, "")]
    if has_intrinsics({normalised(key) for key, _ in own}):
        below = [(key, value) for key, value in node.items() if not is_value(value) and normalised(key) not in _PARTS]
        rest = [pair for key, value in below for pair in _flat(value, f"{key}.")]
        yield name, [*inherited, *rest, *own]
        return
    for key, value in node.items():
        if isinstance(value, dict | list) and not is_value(value):
            inner = f"{name}.{key}" if name else str(key)
            yield from _nodes(value, inner, [*inherited, *own], depth + 1)


def _named_in(part: str, key: str) -> str:
    """What a key of a group means on its own: the `width` of a region of interest, the `type` of a distortion."""
    if part == "roi":
        return f"roi.{key}"
    own_words = {"type": "distortion_model", "model": "distortion_model", "parameters": "distortion_coefficients"}
    return own_words.get(key, key) if part == "distortion" else key


def _flat(node: Any, prefix: str) -> Pairs:
    """All values below a node, under the last part of their names (dotted where that would say something else)."""
    if isinstance(node, list) and not is_value(node):
        return []
    if is_value(node):
        return [(prefix.rstrip("."), node)] if prefix else []
    return [pair for key, value in node.items() for pair in _flat(value, f"{prefix}{key}.")]


def _undotted(tree: Any) -> Any:
    """`Camera.fx: 1` as `Camera: {fx: 1}`; what `Camera` says holds for `Camera1` and `Camera2` too (ORB-SLAM)."""
    if not isinstance(tree, dict):
        return tree
    result: dict[str, Any] = {}
    for key, value in tree.items():
        parts = str(key).split(".")
        if len(parts) == 1 or not all(re.fullmatch(r"[A-Za-z_]\w*", part) for part in parts):
            result[key] = value
            continue
        place = result
        for part in parts[:-1]:
            inner = place.setdefault(part, {})
            if not isinstance(inner, dict):
                inner = place[part] = {}
            place = inner
        place[parts[-1]] = value
    shared = result.get("Camera")
    if isinstance(shared, dict):
        scale = result.get("RGBD", {}).get("DepthMapFactor") if isinstance(result.get("RGBD"), dict) else None
        scale = scale if scale is not None else result.get("DepthMapFactor")
        shared = shared | ({"DepthMapFactor": scale} if scale is not None else {})
        numbered = [key for key in result if re.fullmatch(r"Camera\d", str(key)) and isinstance(result[key], dict)]
        for key in numbered:
            result[key] = shared | result[key]
        if numbered:
            del result["Camera"]
        else:
            result["Camera"] = shared
    return result


def _is_called(name: str, number: int, wanted: str) -> bool:
    return wanted in (name, name.split(".")[-1], str(number)) or normalised(wanted) == normalised(name)


def _missing(names: set[str]) -> str:
    """What a file lacks that has some of a camera's keys."""
    intrinsics = ("fx", "fy", "cx", "cy")
    return next((name for name in intrinsics if name not in names), "fx")
