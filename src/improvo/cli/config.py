"""Print all settings of a command as YAML, each with what it means, ready to edit and to give back with --config."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Iterator
from typing import Any

from improvo.cli.commands import leaves, settings_class
from improvo.cli.options import add_config_arguments

# command -> its settings, as `module:class`
SETTINGS = {"-".join(words): command.settings for words, command in leaves() if command.settings}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo config`."""
    parser.add_argument("command", nargs="?", default="run", choices=sorted(SETTINGS), help="whose settings")
    parser.add_argument("--preset", metavar="NAME", help="start from a preset, such as `paper`")
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Print the settings."""
    from improvo.cli.flags import comments
    from improvo.cli.options import settings_from
    from improvo.presets import presets

    cls = settings_class(SETTINGS[arguments.command])
    settings = settings_from(cls, arguments)
    names = ", ".join(presets(cls.__name__))
    print(f"# improvo {arguments.command.replace('-', ' ')}" + (f"; presets: {names}" if names else ""))
    print("\n".join(_lines(settings, comments)))
    return 0


def _lines(settings: Any, comments: Any, indent: str = "") -> Iterator[str]:
    """The YAML of a dataclass with the comments of its fields."""
    from improvo.config import to_dict, yaml_line

    plain = to_dict(settings)
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        comment = comments(type(settings)).get(field.name, "")
        note = f"  # {comment}" if comment else ""
        if dataclasses.is_dataclass(value):
            yield f"{indent}{field.name}:{note}"
            yield from _lines(value, comments, f"{indent}  ")
        else:
            yield f"{indent}{field.name}: {yaml_line(plain[field.name])}{note}"
