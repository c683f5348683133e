"""`report.html` of labelled sequences: totals, what failed and why, and each sequence's map and warnings."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from improvo.errors import PLOTS_MISSING, plots_installed
from improvo.labeling.store import DONE, read_records
from improvo.odometry.run.run_folder import RunFolder
from improvo.report.map_picture import map_png
from improvo.report.page import Page, plain
from improvo.report.palettes import PALETTES, Palette
from improvo.report.plain_words import LABEL_WORDS, warnings
from improvo.terminal import counted

_MAX_MAPS = 12
_MAX_NAMES = 3  # of recordings, in the title
_COLUMNS = (
    "name", "state", "frames", "tracked", "trusted", "segments", "tracks", "stable", "unstable", "ignore", "withheld",
    "seconds",
)  # fmt: skip


def write_label_page(folder: Path, path: Path, palette: Palette = PALETTES["paper"]) -> None:
    """Write the page of a folder of `improvo label`.

    Raises:
        InputError: a record cannot be read.
    """
    rows = [asdict(record) for record in read_records(folder)]
    runs = [RunFolder(run_json.parent) for run_json in sorted(folder.glob("[!.]*/run.json"))]
    totals = {name: sum(int(row[name]) for row in rows) for name in ("stable", "unstable", "ignore", "withheld")}
    page = Page(
        f"Labels of {_named([str(row['name']) for row in rows])}",
        f"{counted(len(rows), 'sequence')}, labelled by the command improvo label.",
        folders=[Path(str(row["path"])).parent for row in rows],
    )
    page.tiles(
        [
            (f"{len(runs)} of {len(rows)}", "sequences with labels"),
            (f"{sum(int(row['tracked']) for row in rows):,}", "frames with a pose"),
            *((f"{count:,}", f"tracks: {name}") for name, count in totals.items()),
        ]
    )
    failed = [f"{row['name']} has no labels: {row['reason']}." for row in rows if row["state"] != DONE]
    page.warnings(failed, "Every sequence has labels.")
    page.heading("Sequences")
    page.table(_COLUMNS, [[_words(row[name]) for name in _COLUMNS] for row in rows])
    page.paragraph(
        "Columns of tracks: stable ones fit the camera's motion, unstable ones contradict it. " + LABEL_WORDS, note=True
    )
    for run in runs[:_MAX_MAPS]:
        page.html(f"<h3>{plain(run.name)}</h3>")
        page.warnings(
            warnings(run.report, np.zeros(0, np.int64), np.zeros(0), float("nan")),
            "Every frame has a pose, in one segment.",
        )
        if len(run.trajectory) and not plots_installed():
            page.paragraph(f"Its map, seen from above: {PLOTS_MISSING}.", note=True)
        elif len(run.trajectory):
            page.picture(map_png(run, palette), f"{run.name} from above", map_png(run, palette, narrow=True))
    page.write(path)


def _named(names: list[str]) -> str:
    """The recordings, or the first of them."""
    shown = ", ".join(names[:_MAX_NAMES])
    return shown if len(names) <= _MAX_NAMES else f"{shown} and {len(names) - _MAX_NAMES} more"


def _words(value: Any) -> str:
    return f"{value:,.1f}" if isinstance(value, float) else ("-" if value is None else str(value))
