"""Settings: frozen dataclasses, read from YAML and from `section.name=value` overrides; unknown keys raise."""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import functools
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

from improvo.errors import ConfigError, InputError
from improvo.untrusted.paths import check_is_file, check_path
from improvo.untrusted.text import load_yaml, reason

T = TypeVar("T")
SEEDS = 2**32  # so many there are: what all generators of random numbers take
_LONGEST_VALUE = 60  # characters of a value in a message

# Settings that were renamed: the section, what a setting there was called, and what it is called now. Files that were
# written under a former name stay readable.
FORMER_NAMES: dict[str, dict[str, str]] = {
    "labels": {"second_opinion": "quality"},
    "improve": {"held_back": "split", "judge": "validation"},
    "odometry": {"initialisation": "mode", "trust": "ransac_gate"},
    "matching": {"max_stray": "flow_outlier_limit"},
    "pairs": {"rehearsed_share": "replay_share"},
}

# Settings of the odometry that are none any more (docs/odometry.md, "The numbers"): a message says so.
FORMER_SETTINGS: dict[str, frozenset[str]] = {
    "odometry": frozenset({"health", "objective", "solver", "paper_solver"}),
    "odometry.matching": frozenset({"search_radius", "search_frames"}),
    "odometry.start": frozenset(
        {"min_common_tracks", "min_matches", "min_off_plane_points", "min_rotation_residual", "max_buffered"}
        | {"epipolar_error", "max_homography_ratio", "plane_ratio", "max_second_motion", "min_parallax_deg"}
        | {"min_inlier_share", "max_mean_error", "max_lost", "max_cooldown"}
    ),
    "odometry.ransac_gate": frozenset({"enough"}),
    "odometry.window": frozenset(
        {"keyframe_interval", "keyframes", "fixed", "keyframe_motion", "keyframe_shared", "max_error"}
    ),
    "odometry.loss": frozenset({"min_inlier_share", "min_inliers", "wrong_share"}),
    "odometry.refinement": frozenset({"max_start", "max_move", "min_correlation", "max_deviation", "max_area_ratio"}),
    "odometry.verdict": frozenset(
        {"window", "scale_share", "usual_noise", "max_focal_change", "max_focal_error", "max_scale_error"}
    ),
    "odometry.bridging": frozenset({"max_scale_error"}),
    "odometry.attached": frozenset({"noise", "min_flow", "min_moving_cells"}),
}


def to_dict(settings: Any) -> dict[str, Any]:
    """The settings as plain nested dictionaries, tuples as lists, ready for YAML or JSON."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items()}
        return [plain(item) for item in value] if isinstance(value, list | tuple) else value

    result: dict[str, Any] = plain(dataclasses.asdict(settings))
    return result


def to_yaml(settings: Any) -> str:
    """The settings as YAML that `load` reads back."""
    import yaml

    return yaml.safe_dump(to_dict(settings), sort_keys=False)


def yaml_line(value: Any) -> str:
    """A plain value as YAML on one line, however long it is and whatever is in its words."""
    import yaml

    options: dict[str, Any] = {"default_flow_style": True, "width": math.inf}
    text = str(yaml.safe_dump(value, **options)).removesuffix("\n...\n").rstrip("\n")
    if "\n" in text:  # words with a line break, which quotes alone write as `\n`
        text = str(yaml.safe_dump(value, default_style='"', **options)).rstrip("\n")
    return text


def load(cls: type[T], path: Path | None = None, overrides: Iterable[str] = (), base: T | None = None) -> T:
    """Settings of type `cls` from defaults (or `base`, such as a preset), a YAML file and `a.b=value` overrides.

    Args:
        cls: a frozen dataclass of settings.
        path: YAML file with some or all of them.
        overrides: `section.name=value` each; they win over the file.
        base: what counts where neither says anything; the defaults if None.

    Raises:
        ConfigError: a file that is no YAML mapping, an unknown key, or a value of the wrong type.
    """
    section = section_of(cls)
    merged: dict[str, Any] = {}
    if path is not None:
        try:
            check_is_file(check_path(path))
            loaded = load_yaml(path.read_text(encoding="utf-8")) or {}
        except InputError as error:
            raise ConfigError(str(error)) from None
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"{path}: cannot be read as YAML ({reason(error)}); `improvo config` prints a valid file"
            ) from None
        if not isinstance(loaded, dict):
            raise ConfigError(f"{path}: must hold `key: value` pairs; `improvo config` prints a valid file")
        merged = with_present_names(loaded, section)
    for override in overrides:
        name, separator, text = override.partition("=")
        if not separator:
            raise ConfigError(f"--set {override}: write it as section.name=value")
        target, below = merged, section
        *sections, leaf = name.strip().split(".")
        for part in sections:
            below = _present_name(below, part)
            target = target.setdefault(below, {})
            if not isinstance(target, dict):
                raise ConfigError(f"--set {override}: {part} is a value, not a section")
        try:
            target[_present_name(below, leaf)] = load_yaml(text)
        except ValueError:
            raise ConfigError(f"--set {override}: the value is not readable") from None
    return from_dict(cls, merged, str(path) if path else "settings", base)


def from_dict(cls: type[T], values: dict[str, Any], where: str = "settings", base: T | None = None) -> T:
    """Build the dataclass `cls` from nested dictionaries; what they leave out is as in `base`, or as in the defaults.

    Args:
        cls: a frozen dataclass of settings.
        values: some or all of them, under present or former names.
        where: what to call the source in a message.
        base: what counts where `values` says nothing; the defaults if None.

    Raises:
        ConfigError: an unknown key (with the nearest known one) or a value of the wrong type.
    """
    from cattrs.errors import ClassValidationError

    values = with_present_names(values, section_of(cls))
    _refuse_unknown_keys(cls, values, where, prefix="")
    if base is None and all(_has_default(field) for field in dataclasses.fields(cls)):  # type: ignore[arg-type]
        base = cls()
    if base is not None:
        # a section given in part keeps what this class has for the rest of it, not the section's own defaults
        values = over(to_dict(base), values)
    try:
        settings: T = _converter().structure(values, cls)
        _check_numbers(settings)
        return settings
    except ClassValidationError as error:
        first = _first_reason(error)
        raise ConfigError(first if first.startswith("--") else f"{where}: {first}") from None
    except (TypeError, ValueError, OverflowError, AttributeError, LookupError) as error:
        raise ConfigError(f"{where}: {reason(error)}") from None


def check_seed(seed: int) -> None:
    """Refuse a seed that not every generator of random numbers takes.

    Raises:
        ConfigError: it is negative, or too large.
    """
    if not 0 <= seed < SEEDS:
        raise ConfigError(f"seed={seed}: must be 0 or more, and less than {SEEDS}")


def _check_numbers(settings: Any, prefix: str = "") -> None:
    """Refuse, in all sections, numbers that none of them can mean.

    Raises:
        ValueError: infinite, no number, or a seed that a generator of random numbers does not take.
    """
    for each in dataclasses.fields(settings):
        name, value = f"{prefix}{each.name}", getattr(settings, each.name)
        if dataclasses.is_dataclass(value):
            _check_numbers(value, f"{name}.")
        elif not all(math.isfinite(number) for number in _floats(value)):
            raise ValueError(f"setting `{name}`: {_shown(value)} is no finite number")
        elif each.name == "seed" and isinstance(value, int) and not 0 <= value < SEEDS:
            raise ValueError(f"setting `{name}`: {value} must be 0 or more, and less than {SEEDS}")


def _floats(value: Any) -> list[float]:
    """A number, or all in nested tuples."""
    if isinstance(value, tuple):
        return [number for item in value for number in _floats(item)]
    return [value] if isinstance(value, float) else []


def with_present_names(values: Any, section: str = "") -> Any:
    """Nested dictionaries of settings as they are called now (see FORMER_NAMES).

    Args:
        values: of one section, or of several as nested dictionaries.
        section: the name of the section that `values` is; empty for settings that are made of sections.
    """
    if not isinstance(values, dict):
        return values
    renamed = {}
    for key, value in values.items():
        present = _present_name(section, key)
        if present == key or present not in values:
            renamed[present] = with_present_names(value, present)
    return renamed


def _present_name(section: str, key: Any) -> Any:
    return FORMER_NAMES.get(section, {}).get(key, key) if isinstance(section, str) and isinstance(key, str) else key


def section_of(cls: type) -> str:
    """`odometry` for `OdometrySettings`."""
    return cls.__name__.removesuffix("Settings").lower()


def over(defaults: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """Nested dictionaries: the values, and the defaults where there is none."""
    result = dict(defaults)
    for key, value in values.items():
        below = result.get(key)
        result[key] = over(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return result


@functools.cache
def _converter() -> Any:
    """Takes values of the right type alone; it writes code for each class once, which takes longer than using it."""
    import cattrs

    converter = cattrs.Converter(forbid_extra_keys=True)
    for kind in (bool, int, float, str):
        converter.register_structure_hook(kind, _strict(kind))
    return converter


def _has_default(field: dataclasses.Field[Any]) -> bool:
    return field.default is not dataclasses.MISSING or field.default_factory is not dataclasses.MISSING


def _strict(kind: type) -> Any:
    accepted = (int, float) if kind is float else kind

    def structure(value: Any, _: Any) -> Any:
        if kind is float and isinstance(value, str):  # YAML takes 3e-4, without a point, for a word
            with contextlib.suppress(ValueError, OverflowError):
                return float(value)
        if not isinstance(value, accepted) or (isinstance(value, bool) and kind is not bool):
            raise ValueError(f"{_shown(value)} is not of type {kind.__name__}")
        try:
            return kind(value)
        except OverflowError:
            raise ValueError(f"{_shown(value)} is too large") from None

    return structure


def _shown(value: Any) -> str:
    """A value in a message, shortened; a number may have thousands of digits, more than Python writes."""
    try:
        text = repr(value)
    except ValueError:
        return "a number of thousands of digits"
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 3]}..."


def _refuse_unknown_keys(cls: type, values: Any, where: str, prefix: str) -> None:
    import typing

    if not isinstance(values, dict):
        raise ConfigError(f"{where}: {prefix.rstrip('.')} must hold `key: value` pairs")
    hints = typing.get_type_hints(cls)
    known = {f.name: hints[f.name] for f in dataclasses.fields(cls)}
    for key, value in values.items():
        if key not in known:
            shown = key if isinstance(key, str) and len(key) <= _LONGEST_VALUE else _shown(key)
            close = difflib.get_close_matches(shown, known, n=1)
            mend = f"did you mean `{prefix}{close[0]}`?" if close else f"known: {', '.join(known)}"
            if key in FORMER_SETTINGS.get(prefix.rstrip("."), ()):
                mend = "it follows from others now, or never mattered: leave it out"
            raise ConfigError(f"{where}: unknown setting `{prefix}{shown}`; {mend}")
        if dataclasses.is_dataclass(known[key]):
            _refuse_unknown_keys(known[key], value, where, f"{prefix}{key}.")


def _first_reason(error: Any) -> str:
    """The innermost message of a nested validation error, with the path to the field."""
    path: list[str] = []
    while getattr(error, "exceptions", None):
        error = error.exceptions[0]
        path += [str(note).rsplit(" ", 1)[-1] for note in getattr(error, "__notes__", []) if "attribute" in note]
    where = ".".join(path)
    named = not path or f"`{where}." in str(error) or f"`{where}`" in str(error) or str(error).startswith("--")
    return str(error) if named else f"setting `{where}`: {error}"
