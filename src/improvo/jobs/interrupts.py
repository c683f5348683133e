"""Ctrl-C, SIGTERM and a closed terminal (SIGHUP): all interrupt a command alike, and not in the middle of a frame."""

from __future__ import annotations

import os
import signal
import stat
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from types import FrameType
from typing import NoReturn


def hang_up(number: int, frame: FrameType | None) -> NoReturn:
    """The handler of SIGHUP: the terminal is gone, and what is printed to it from here on must not be an error."""
    _leave_terminal()
    raise KeyboardInterrupt


_SIGHUP = getattr(signal, "SIGHUP", None)  # Windows has none
_SIGNALS = (signal.SIGINT, signal.SIGTERM, *(() if _SIGHUP is None else (_SIGHUP,)))
_HANDLERS = {signal.SIGTERM: signal.default_int_handler, **({} if _SIGHUP is None else {_SIGHUP: hang_up})}


@contextmanager
def termination_interrupts() -> Iterator[None]:
    """Within the block SIGTERM and SIGHUP raise KeyboardInterrupt, as Ctrl-C does: what ends a service or a session
    leaves a valid result.

    A handler that the program has set for one is left alone, as is a signal that is ignored (`nohup`).
    """
    with ExitStack() as after:
        if _in_main_thread():
            for number, handler in _HANDLERS.items():
                if signal.getsignal(number) is signal.SIG_DFL:
                    signal.signal(number, handler)
                    after.callback(signal.signal, number, signal.SIG_DFL)
        yield


@contextmanager
def interrupts_wait() -> Iterator[None]:
    """An interrupt takes effect at the end of the block.

    In the middle, compiled code would make a SystemError of it, and half a frame would be left.
    """
    before = {one: signal.getsignal(one) for one in _SIGNALS}
    mine = {one: handler for one, handler in before.items() if handler in (signal.default_int_handler, hang_up)}
    if not mine or not _in_main_thread():
        yield
        return
    came: list[int] = []
    for one in mine:
        signal.signal(one, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for one, handler in mine.items():
            signal.signal(one, handler)
    if came:
        if _SIGHUP in came:
            _leave_terminal()
        raise KeyboardInterrupt


def _leave_terminal() -> None:
    """Print nowhere, where it would be to the terminal; a log file stays."""
    for stream in (1, 2):
        with suppress(OSError):
            if stat.S_ISCHR(os.fstat(stream).st_mode):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, stream)
                os.close(nowhere)


def _in_main_thread() -> bool:
    """Only there may handlers be set."""
    return threading.current_thread() is threading.main_thread()
