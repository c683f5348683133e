"""One HTML page about a finished run, labelling or evaluation: a single file that opens from disk, to send on."""

from __future__ import annotations

import argparse
from pathlib import Path

from improvo.cli.output import next_step, say
from improvo.cli.show_options import add_palette, add_recording, target_path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The folder and where the page goes."""
    parser.add_argument(
        "folder", type=Path, metavar="OUT", help="output folder of `improvo run`, `label` or `evaluate`"
    )
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="page to write (default: OUT/report.html)")
    add_recording(parser)
    add_palette(parser)


def run(arguments: argparse.Namespace) -> None:
    """Write the page."""
    from improvo.report.pages import write_report
    from improvo.report.palettes import palette

    target = target_path(arguments.output, arguments.folder, "report.html", (".html", ".htm"))
    write_report(arguments.folder, target, palette(arguments.palette), arguments.sequence)
    say(str(target))
    next_step("open it in a browser; it is one file, to send on as it is")
