"""Instability against its true cause: of the labels of a run on a simulated recording, and of stability heads.

LABELS is what `improvo run` or `improvo label` left for the recording SIMULATION (made by `improvo simulate`), or a
folder of several such folders that are named like the recordings in SIMULATION.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from improvo.cli.output import figures, next_after_figures, say

COMMAND = "evaluate stability"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `improvo evaluate stability`."""
    parser.add_argument("labels", type=Path, metavar="LABELS", help="folder with points.parquet and tracks.parquet")
    parser.add_argument("simulation", type=Path, metavar="SIMULATION", help="folder made by `improvo simulate`")
    parser.add_argument(
        "--frontend", action="append", default=[], metavar="NAME", help="also measure this stability head; repeatable"
    )
    parser.add_argument("--max-keypoints", type=int, default=500, metavar="N", help="of a frontend, per image")
    parser.add_argument("--every", type=int, default=10, metavar="N", help="frames between those shown to a frontend")
    parser.add_argument("-o", "--output", type=Path, metavar="OUT", help="folder for the results")


def run(arguments: argparse.Namespace) -> int:
    """Print the table; with -o leave stability.json, stability.md and stability.png."""
    from improvo import __version__
    from improvo.errors import ConfigError
    from improvo.evaluation.stability.protocol import (
        ScoredPoints,
        paired_folders,
        score_head,
        score_labels,
        stability_table,
        summarise,
    )
    from improvo.files import check_output_folder, make_output_folder, write_json, write_text

    if arguments.every < 1 or arguments.max_keypoints < 1:
        raise ConfigError("--every and --max-keypoints: must be at least 1")
    if arguments.output is not None:
        check_output_folder(arguments.output, COMMAND)
    pairs = paired_folders(arguments.labels, arguments.simulation)
    scored = {"labels": ScoredPoints.joined(score_labels(labels, simulation) for labels, simulation in pairs)}
    for name in arguments.frontend:
        from improvo.frontend.registry import load_frontend

        frontend = load_frontend(name, max_keypoints=arguments.max_keypoints)
        scored[name] = ScoredPoints.joined(score_head(frontend, simulation, arguments.every) for _, simulation in pairs)
    results = {
        "protocol": "stability",
        "improvo": __version__,
        "pairs": [{"labels": str(labels), "simulation": str(simulation)} for labels, simulation in pairs],
        "subjects": [{"name": name, **summarise(points)} for name, points in scored.items()],
    }
    text = stability_table(results)
    figures(results, text)
    if arguments.output is not None:
        from improvo.errors import PLOTS_MISSING, plots_installed
        from improvo.evaluation.stability.plot import draw_stability

        make_output_folder(arguments.output, COMMAND)
        write_json(arguments.output / "stability.json", results)
        write_text(arguments.output / "stability.md", text)
        if plots_installed():
            draw_stability(scored, results, arguments.output / "stability.png")
        else:
            say(f"without stability.png; {PLOTS_MISSING} draws it")
    next_after_figures(arguments.output)
    return 0
