"""`metrics.jsonl`: one row of figures every few steps, appended while a training runs.

A full disk or a power cut can leave half a row at the end. Readers leave such a row out.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from improvo import files
from improvo.errors import OutputError

METRICS = "metrics.jsonl"


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """The whole rows of a file, in order; none where there is no file."""
    if not path.is_file():
        return []
    rows = (_row(line) for line in path.read_text(errors="replace").splitlines())
    return [row for row in rows if row is not None]


def append_metrics(path: Path, row: dict[str, Any]) -> None:
    """Add a row.

    Raises:
        OutputError: it cannot be written (full disk).
    """
    try:
        with path.open("a") as stream:
            stream.write(json.dumps(row) + "\n")
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({error.strerror or error}); make room, and run again to go on from here"
        ) from None


def keep_metrics(path: Path, step: int) -> None:
    """Drop the rows behind a step, and damaged ones: what a continued training writes again."""
    if path.is_file():
        files.write_text(path, "".join(json.dumps(row) + "\n" for row in read_metrics(path) if row["step"] <= step))


def _row(line: str) -> dict[str, Any] | None:
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return row if isinstance(row, dict) and isinstance(row.get("step"), int) else None
