"""How far a long command is: a bar on a terminal, elsewhere a line now and then, and nothing where it is quiet."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, TextIO, TypeVar

T = TypeVar("T")

INTERVAL = 20.0  # seconds between two lines, where there is no terminal
_CONTROLS = {*range(0x20), *range(0x7F, 0xA0)} - {ord("\t"), ord("\n")}
_DIRECTIONS = {0x200E, 0x200F, *range(0x202A, 0x202F), *range(0x2066, 0x206A)}  # turn the text around
_SHOWN = {code: repr(chr(code))[1:-1] for code in _CONTROLS | _DIRECTIONS}
_quiet = False


def counted(count: int, unit: str) -> str:
    """`1 frame`, `2 frames`."""
    return f"{count} {unit}" if count == 1 else f"{count} {unit}s"


def tell(line: str, stream: TextIO) -> None:
    """Print a line about work that goes on whether or not anybody listens, as behind `| head -1`."""
    try:
        print(line, file=stream, flush=True)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def printable(text: str) -> str:
    """A text with what a terminal would obey rather than show written as `\\x1b`: names of files may hold anything."""
    return text.translate(_SHOWN)


def one_line(text: str) -> str:
    """As `printable`, with line breaks written as `\\n`, too."""
    return printable(text.replace("\n", "\\n"))


@contextmanager
def quiet(quiet: bool = True) -> Iterator[None]:
    """Show no progress within; `quiet` False shows it."""
    global _quiet
    before, _quiet = _quiet, quiet
    try:
        yield
    finally:
        _quiet = before


class Progress:
    """Told by a loop how far it is; shows nothing itself."""

    def advance(self, count: int = 1) -> None:
        """So many more are done."""

    def describe(self, words: str) -> None:
        """What is being done from here on."""

    def note(self, text: str) -> None:
        """A remark beside the bar."""


@contextmanager
def progress(words: str, unit: str, total: int | None = None, shown: bool = True, done: int = 0) -> Iterator[Progress]:
    """Show the progress of the block on stderr.

    Args:
        words: what is being done.
        unit: of what is counted, in the singular.
        total: how many there are, where that is known.
        shown: False shows nothing.
        done: so many are done already.
    """
    if not shown or _quiet:
        yield Progress()
    elif sys.stderr.isatty():
        from tqdm import tqdm

        with tqdm(desc=words, unit=unit, total=total, initial=done, smoothing=0.1, delay=0.5, leave=False) as bar:
            yield _Bar(bar)
    else:
        yield _Lines(words, unit, total, done, sys.stderr)


def each(items: Collection[T], words: str, unit: str, shown: bool = True) -> Iterator[T]:
    """The items, with the progress of the loop over them; arguments as `progress`."""
    with progress(words, unit, len(items), shown) as told:
        for item in items:
            yield item
            told.advance()


@contextmanager
def stages(unit: str) -> Iterator[Callable[[str, int, int], None]]:
    """Show the progress of work with several stages, each as a `progress` of its own.

    Yields:
        What to tell: the stage in words, how many are done, and of how many.
    """
    now, before = "", 0  # the stage, and how many of it were done when it was last heard of
    bar = Progress()
    with ExitStack() as shown:

        def told(stage: str, done: int, total: int) -> None:
            nonlocal bar, now, before
            if stage != now or done < before:  # the next stage, or the same of the next recording
                shown.close()
                bar, now, before = shown.enter_context(progress(stage, unit, total)), stage, 0
            bar.advance(done - before)
            before = done

        yield told


class _Bar(Progress):
    """The clock starts with the first unit: what comes before it, such as loading, would spoil the first estimates."""

    def __init__(self, bar: Any) -> None:
        self._bar = bar
        self._began = False

    def advance(self, count: int = 1) -> None:
        if self._began:
            self._bar.update(count)
            return
        self._began = True
        bar = self._bar
        bar.n += count
        bar.initial = bar.last_print_n = bar.n
        bar.start_t = bar.last_print_t = time.time()
        bar.refresh()

    def describe(self, words: str) -> None:
        self._bar.set_description(words)

    def note(self, text: str) -> None:
        self._bar.set_postfix_str(text, refresh=False)


class _Lines(Progress):
    def __init__(self, words: str, unit: str, total: int | None, done: int, stream: TextIO) -> None:
        self._words, self._unit, self._total, self._stream = words, unit, total, stream
        self._first = self._done = done
        self._note = ""
        self._said = time.monotonic()
        self._began: float | None = None  # when the first unit was done: the rate is that of the others

    def advance(self, count: int = 1) -> None:
        self._done += count
        now = time.monotonic()
        if self._began is None:
            self._began, self._first = now, self._done
        if now - self._said >= INTERVAL:
            self._said = now
            tell(self._text(now - self._began), self._stream)

    def describe(self, words: str) -> None:
        self._words = words

    def note(self, text: str) -> None:
        self._note = text

    def _text(self, seconds: float) -> str:
        rate = (self._done - self._first) / max(seconds, 1e-9)
        speed = f", {rate:.3g} a second" if rate > 0 else ""
        if self._total:
            share = 100 * self._done // self._total
            text = f"{self._words}: {self._done} of {counted(self._total, self._unit)} ({share} %){speed}"
            if rate > 0:
                text += f", {_duration((self._total - self._done) / rate)} left"
        else:
            text = f"{self._words}: {counted(self._done, self._unit)}{speed}"
        return f"{text}; {self._note}" if self._note else text


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(round(max(seconds, 0)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"
