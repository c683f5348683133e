"""What the commands print: lines for people on stdout, or with --json one JSON value; --quiet leaves results alone."""

from __future__ import annotations

import json
import sys
from typing import Any

from improvo import terminal

_silent = False  # no lines for people
_as_json = False


def configure(quiet: bool = False, as_json: bool = False) -> None:
    """Set by `main` for the command that follows."""
    global _silent, _as_json
    _silent, _as_json = quiet or as_json, as_json
    terminal.be_quiet(quiet)


def say(text: str) -> None:
    """A line about what was done; left out by --quiet and --json."""
    if not _silent:
        terminal.line(text)


def next_step(text: str) -> None:
    """The last line: what to do next."""
    say(f"next: {text}")


def notice(text: str) -> None:
    """A line on stderr about work that takes a while."""
    if not _silent:
        print(text, file=sys.stderr, flush=True)


def figures(data: Any, text: str) -> None:
    """The result of a command that ends in figures: a text for people, or JSON with --json; --quiet prints it too."""
    if _as_json:
        print(json.dumps(data, indent=2))
    elif text:
        terminal.line(text)


def as_json() -> bool:
    """Whether the command was given --json."""
    return _as_json
