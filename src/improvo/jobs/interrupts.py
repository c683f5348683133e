"""Ctrl-C and SIGTERM: both interrupt a command in the same way, and not in the middle of a frame."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def termination_interrupts() -> Iterator[None]:
    """Within the block SIGTERM raises KeyboardInterrupt, as Ctrl-C does: what stops a service leaves a valid result.

    A handler that the program has set for it is left alone.
    """
    if not _in_main_thread() or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


@contextmanager
def interrupts_wait() -> Iterator[None]:
    """An interrupt takes effect at the end of the block.

    In the middle, compiled code would make a SystemError of it, and half a frame would be left.
    """
    mine = [one for one in _SIGNALS if signal.getsignal(one) is signal.default_int_handler]
    if not mine or not _in_main_thread():
        yield
        return
    came: list[int] = []
    for one in mine:
        signal.signal(one, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for one in mine:
            signal.signal(one, signal.default_int_handler)
    if came:
        raise KeyboardInterrupt


def _in_main_thread() -> bool:
    """Only there may handlers be set."""
    return threading.current_thread() is threading.main_thread()
