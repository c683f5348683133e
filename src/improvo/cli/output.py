"""What the commands print: lines for people on stdout, or with --json one JSON value; --quiet leaves results alone."""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from improvo import terminal
from improvo.locations import with_urls

_silent = False  # no lines for people
_as_json = False


@contextmanager
def configured(quiet: bool, as_json: bool) -> Iterator[None]:
    """For the command within; a command may run others."""
    global _silent, _as_json
    before = _silent, _as_json
    _silent, _as_json = quiet or as_json, as_json
    try:
        with terminal.quiet(quiet):
            yield
    finally:
        _silent, _as_json = before


def say(text: str) -> None:
    """A line about what was done; left out by --quiet and --json."""
    if not _silent:
        _line(text)


def next_step(text: str) -> None:
    """The last line: what to do next."""
    say(f"next: {text}")


def next_after_figures(folder: Path | None) -> None:
    """The last line of an evaluation: a page of the folder of its results, or how to keep them."""
    if folder is None:
        next_step("the same with -o OUT keeps the figures, and `improvo report OUT` makes a page of them")
    else:
        next_step(f"`improvo report {typed(folder)}` makes a page of it")


def notice(text: str) -> None:
    """A line on stderr about work that takes a while."""
    if not _silent:
        terminal.tell(terminal.printable(text), sys.stderr)


def typed(word: object) -> str:
    """A path or another word of a command, in quotes where a shell would take it apart or run what is in it."""
    return shlex.quote(str(word))


def figures(data: Any, text: str) -> None:
    """The result of a command that ends in figures: a text for people, or JSON with --json; --quiet prints it too."""
    if _as_json:
        print(json.dumps(data, indent=2, allow_nan=False))
    elif text:
        _line(text.rstrip("\n"))


def as_json() -> bool:
    """Whether the command was given --json."""
    return _as_json


def _line(text: str) -> None:
    """Print past the progress bars, where there are any."""
    text = terminal.printable(with_urls(text))
    if "tqdm" not in sys.modules:
        terminal.tell(text, sys.stdout)
        return
    from tqdm import tqdm

    with tqdm.external_write_mode():
        terminal.tell(text, sys.stdout)
