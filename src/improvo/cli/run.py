"""`improvo run SEQUENCE -o OUT`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from improvo.cli.options import (
    FRONTEND_FLAGS,
    add_config_arguments,
    add_frontend_arguments,
    add_sequence_arguments,
    settings_from,
)
from improvo.odometry.run_settings import RunSettings

if TYPE_CHECKING:
    from improvo.odometry.run import RunSummary
    from improvo.odometry.view import View
    from improvo.odometry.visualizer import Visualizer
    from improvo.sequences import Sequence

_FLAGS = {**FRONTEND_FLAGS, "initialisation": "odometry.mode"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo run`."""
    defaults = RunSettings()
    parser.add_argument("sequence", type=Path, metavar="SEQUENCE", help="a video, an image folder or a data set")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="folder for the results")
    add_frontend_arguments(parser, defaults.frontend.name, defaults.frontend.max_keypoints)
    parser.add_argument(
        "--initialisation",
        choices=("robust", "paper"),
        default=argparse.SUPPRESS,
        help="robust, or the paper's: previous pose, unit depth, nothing else (default: robust)",
    )
    parser.add_argument(
        "--no-stability", action="store_true", help="weigh all observations alike (default: by stability)"
    )
    parser.add_argument("--view", action="store_true", help="watch the run in Rerun (pip install 'improvo[view]')")
    parser.add_argument("--save", type=Path, metavar="FILE.rrd", help="record it for Rerun; works without a screen")
    parser.add_argument(
        "--report", action="store_true", help="write OUT/report.html at the end, as `improvo report` does"
    )
    add_sequence_arguments(parser)
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Track the sequence and write the results; 130 after an interrupt."""
    settings = settings_from(RunSettings, arguments, _FLAGS)
    if arguments.no_stability:
        settings = settings_from(RunSettings, arguments, _FLAGS, extra=["frontend.use_stability=false"])
    from improvo.files import check_output_folder
    from improvo.sequences import open_sequence

    check_output_folder(arguments.output, "run")
    sequence = open_sequence(arguments.sequence, settings.sequence)
    camera = sequence.camera
    frames = "live, Ctrl-C ends it: frames" if sequence.length is None else f"{sequence.length} frames"
    print(
        f"{sequence.name}: {sequence.format}, {frames} of {camera.width}x{camera.height}; "
        f"frontend {settings.frontend.name}; poses and map are up to scale"
    )
    summary = _track(sequence, arguments.output, settings, _viewer(arguments))
    _print_summary(summary)
    if arguments.report:
        from improvo.report.pages import write_report

        write_report(arguments.output, arguments.output / "report.html")
        print(f"page in {arguments.output / 'report.html'}")
    return 130 if summary.report["interrupted"] else 0


def _viewer(arguments: argparse.Namespace) -> Visualizer | None:
    """Rerun where somebody wants to look."""
    if not arguments.view and arguments.save is None:
        return None
    from improvo.report.rerun_viewer import RerunViewer

    return RerunViewer(arguments.save)


def _track(sequence: Sequence, folder: Path, settings: RunSettings, viewer: Visualizer | None) -> RunSummary:
    """The run with its progress line."""
    from tqdm import tqdm

    from improvo.odometry.compile import compile_odometry
    from improvo.odometry.run import run_odometry

    compile_odometry(lambda words: print(words, file=sys.stderr))
    with tqdm(total=sequence.length, unit="frame", desc="run", smoothing=0.1, delay=0.5) as bar:

        def progress(view: View) -> None:
            bar.set_postfix_str("no pose yet" if view.cam_from_world is None else "", refresh=False)
            bar.update()

        return run_odometry(sequence, folder, settings, visualizer=viewer, progress=progress)


def _print_summary(summary: RunSummary) -> None:
    report = summary.report
    frames, segments = report["frames"], report["segments"]
    print(
        f"{frames['tracked']} of {frames['processed']} frames have a pose, in {len(segments)} segment(s); "
        f"{report['points']} points; {report['frames_per_second']} frames/s"
    )
    for segment in segments[1:] if len(segments) > 1 else []:
        print(f"  segment {segment['number']} starts at frame {segment['first']}: own scale, placed by guess")
    warnings = [event for event in report["events"] if event["kind"] in ("lost", "contradiction")]
    for event in warnings[:5]:
        print(f"  frame {event['frame_index']}: {event['kind']}: {event['detail']}")
    if len(warnings) > 5:
        print(f"  ... {len(warnings) - 5} more in run.json")
    skipped = report["input"]["skipped"]
    if skipped:
        print(f"  {len(skipped)} frame(s) could not be read, first {skipped[0]['source']}: {skipped[0]['reason']}")
    if report["interrupted"]:
        print("  interrupted: the result ends there, and is complete up to there")
    print(f"results in {summary.folder}; `improvo show map {summary.folder}` draws them")
