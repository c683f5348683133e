"""`report.html` of labelled sequences: the manifest, totals, and each sequence's map and warnings."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from sivo.errors import InputError
from sivo.report.map_picture import draw_map
from sivo.report.page import Page
from sivo.report.palettes import PALETTES, Palette
from sivo.report.plain_words import warnings
from sivo.report.run_folder import RunFolder

_MAX_MAPS = 12


def write_label_page(folder: Path, path: Path, palette: Palette = PALETTES["paper"]) -> None:
    """Write the page of a folder of `sivo label`.

    Raises:
        InputError: the manifest cannot be read.
    """
    rows = _manifest(folder / "manifest.parquet")
    runs = [RunFolder(run_json.parent) for run_json in sorted(folder.glob("**/run.json"))]
    totals = {
        name: sum(int(run.report["tracks"].get(name, 0)) for run in runs) for name in ("stable", "unstable", "ignore")
    }
    page = Page(f"Labels of {len(rows)} sequences", f"In {folder}.")
    page.tiles(
        [
            (str(len(runs)), "sequences with labels"),
            (f"{sum(run.report['frames']['tracked'] for run in runs):,}", "frames with a pose"),
            *((f"{count:,}", f"{name} tracks") for name, count in totals.items()),
        ]
    )
    page.heading("Manifest")
    columns = list(rows[0]) if rows else []
    page.table(columns, [[_words(row[name]) for name in columns] for row in rows])
    page.heading("Sequences")
    page.table(
        ["sequence", "frames", "with a pose", "pieces", "points", "stable", "unstable", "ignored"],
        [
            [
                run.name,
                str(run.frames),
                str(run.report["frames"]["tracked"]),
                str(len(run.report["segments"])),
                str(run.report["points"]),
                *(str(run.report["tracks"].get(name, 0)) for name in totals),
            ]
            for run in runs
        ],
    )
    for run in runs[:_MAX_MAPS]:
        page.html("<h3>" + run.name.replace("&", "&amp;").replace("<", "&lt;") + "</h3>")
        page.warnings(
            warnings(run.report, np.zeros(0, np.int64), np.zeros(0), float("nan")),
            "Every frame has a pose in one piece.",
        )
        if len(run.trajectory):
            with tempfile.TemporaryDirectory() as temporary:
                picture = Path(temporary) / "map.png"
                draw_map(run, picture, palette)
                page.picture(picture, f"{run.name} from above")
    page.write(path)


def _manifest(path: Path) -> list[dict[str, Any]]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        rows: list[dict[str, Any]] = pq.read_table(path, memory_map=False).to_pylist()
    except (pa.ArrowException, OSError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{path}: cannot be read as Parquet ({reason}); run `sivo label` again") from None
    return rows


def _words(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else ("-" if value is None else str(value))
