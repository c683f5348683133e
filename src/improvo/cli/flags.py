"""Flags made from settings: the dataclass gives type, choices and default, the comment beside the field the help."""

from __future__ import annotations

import argparse
import inspect
import re
import types
import typing
from typing import Any, Literal

_FIELD = re.compile(r"^    (\w+): ")
_known: dict[type, dict[str, str]] = {}


def add_setting(
    parser: argparse._ActionsContainer,
    defaults: Any,
    flag: str,
    setting: str,
    help: str = "",
    section: str = "",
    **options: Any,
) -> None:
    """Add a flag that stands for a setting; `improvo.cli.options.settings_from` reads it back.

    Args:
        parser: or a group of one.
        defaults: an instance of the command's settings, whose value is shown as the default.
        flag: such as `--seed`.
        setting: its name, such as `odometry.seed`.
        help: in place of the field's own comment.
        section: where `defaults` lies in the command's settings, such as `sequence.`.
        options: of `add_argument`, in place of what the field says.
    """
    owner, value = defaults, defaults
    for name in setting.split("."):
        owner, value = value, getattr(value, name)
    kind = typing.get_type_hints(type(owner))[name]
    chosen = {**_options(kind), **options}
    text = (help or comments(type(owner)).get(name, "")).replace("%", "%%")
    if value is not None and "(default" not in text:
        text = f"{text} (default: {_shown(value)})".strip()
    action = parser.add_argument(flag, default=argparse.SUPPRESS, help=text, **chosen)
    known = parser.get_default("flags") or {}
    parser.set_defaults(flags={**known, action.dest: f"{section}{setting}"})


def _options(kind: Any) -> dict[str, Any]:
    """What argparse needs to know of a type."""
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        kind = next(part for part in typing.get_args(kind) if part is not type(None))
    if typing.get_origin(kind) is Literal:
        return {"choices": typing.get_args(kind)}
    if typing.get_origin(kind) is tuple:
        return {"type": typing.get_args(kind)[0], "nargs": "+"}
    if kind is bool:
        return {"action": argparse.BooleanOptionalAction}
    if kind in (int, float):
        return {"type": kind, "metavar": "N" if kind is int else "X"}
    return {}


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return " ".join(_shown(each) for each in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def comments(cls: type) -> dict[str, str]:
    """What the source says of each field of a dataclass: the comment behind it, else the one above it."""
    if cls in _known:
        return _known[cls]
    found = _known[cls] = {}
    for base in reversed(cls.__mro__):
        if "__dataclass_fields__" not in vars(base):
            continue
        above: list[str] = []
        for line in inspect.getsource(base).splitlines():
            field = _FIELD.match(line)
            if field:
                _, _, behind = line.partition("  # ")
                found[field[1]] = behind or " ".join(above)
            above = [*above, line.strip("# ")] if line.startswith("    # ") else []
    return found
