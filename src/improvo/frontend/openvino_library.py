"""OpenVINO, imported without its telemetry: the one place that imports it, in every process.

By default, `import openvino` writes a client id into the user's home folder, counts how often it was imported, and
reports it to a web service. It uses the package `openvino_telemetry` for this, and works without it. So that package is
hidden while OpenVINO loads. A program that has imported OpenVINO before us is left alone.

`CORE` is the only core of the process, and is never freed. With its first graph a core gives the calling thread a stack
for signal handlers, and unmaps it when it is freed. Of two cores that are freed in the order in which they were made,
the second puts back the stack of the first, which is gone. The next signal then ends the process with a segmentation
fault: Ctrl-C after two networks were used and dropped (seen with OpenVINO 2026.4).

Graphs are built and compiled within `plain_letters()`. OpenVINO compares the names of options without regard to case by
the letters of the C library, and in Turkish and Azerbaijani `i` is not the small letter of `I`: there, it knows no
`EXPLICIT` padding, and no network could be run.
"""

from __future__ import annotations

import locale
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_TELEMETRY = "openvino_telemetry"


@contextmanager
def _hidden(name: str) -> Iterator[None]:
    """Meanwhile `import NAME` fails, as if it was not installed."""
    missing = object()
    before = sys.modules.get(name, missing)
    sys.modules[name] = None  # type: ignore[assignment]
    try:
        yield
    finally:
        if before is missing:
            del sys.modules[name]
        else:
            sys.modules[name] = before  # type: ignore[assignment]


with _hidden(_TELEMETRY):
    import openvino
    from openvino import opset13

CORE = openvino.Core()

_LETTERS = threading.Lock()  # the locale belongs to the process


@contextmanager
def plain_letters() -> Iterator[None]:
    """Meanwhile the C library has the letters of English; one thread at a time."""
    with _LETTERS:
        before = locale.setlocale(locale.LC_CTYPE)
        if before != "C":
            locale.setlocale(locale.LC_CTYPE, "C")
        try:
            yield
        finally:
            if before != "C":
                locale.setlocale(locale.LC_CTYPE, before)


__all__ = ["CORE", "openvino", "opset13", "plain_letters"]
