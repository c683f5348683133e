"""`improvo report OUT`: one HTML page about a finished run, labelling or evaluation."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The folder and where the page goes."""
    parser.add_argument(
        "folder", type=Path, metavar="OUT", help="output folder of `improvo run`, `label` or `evaluate`"
    )
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="page to write (default: OUT/report.html)")
    parser.add_argument(
        "--sequence", type=Path, metavar="PATH", help="where a run's recording is now (default: where it was)"
    )
    parser.add_argument("--palette", choices=("paper", "colour-blind"), default="paper", help="of the pictures")


def run(arguments: argparse.Namespace) -> None:
    """Write the page."""
    from improvo.cli.show_options import target_path
    from improvo.report.pages import write_report
    from improvo.report.palettes import palette

    target = target_path(arguments.output, arguments.folder, "report.html")
    write_report(arguments.folder, target, palette(arguments.palette), arguments.sequence)
    print(target)
