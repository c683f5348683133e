"""Visual odometry on one sequence.

Leaves trajectory.txt, map.ply, tracks.parquet, points.parquet and run.json in OUT. Poses and map are up to scale,
or in metres with --scale.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from improvo.cli.auto_camera import with_found_camera
from improvo.cli.flags import add_setting
from improvo.cli.options import (
    add_config_arguments,
    add_frontend_arguments,
    add_sequence_arguments,
    folder_path,
    recording_path,
    recording_words,
    settings_from,
)
from improvo.cli.output import figures, next_step, notice, say, typed
from improvo.depth.run_settings import DenseRunSettings
from improvo.odometry.scale.settings import USAGE, scale_settings
from improvo.terminal import counted

if TYPE_CHECKING:
    from improvo.labeling.labeler import LabeledRun
    from improvo.odometry.scale.sources import Ask
    from improvo.odometry.visual_odometry import TrackedFrame
    from improvo.report.rerun_viewer import RerunViewer
    from improvo.sequences import Sequence

NO_RESULT = 3  # exit status where everything was read, and no frame has a pose
_WARNINGS = 5  # printed; run.json has them all
# kinds of events that other lines say, or that are no alarm
_UNSAID = ("initialising", "segment", "doubtful", "withdrawn", "uncertain", "checked again")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo run`."""
    defaults = DenseRunSettings()
    parser.add_argument(
        "sequence", type=recording_path, metavar="SEQUENCE", help="a video, an image folder, a data set, or `demo`"
    )
    parser.add_argument("-o", "--output", type=folder_path, required=True, metavar="OUT", help="folder for the results")
    add_frontend_arguments(parser, defaults)
    add_setting(parser, defaults, "--mode", "odometry.mode", choices=("robust", "paper"))
    parser.add_argument(
        "--no-stability", action="store_true", help="weigh all observations alike (default: by stability)"
    )
    parser.add_argument(
        "--dense", action="store_true", help="add depth maps (depth.zip) and a coloured point cloud (dense.ply)"
    )
    parser.add_argument("--view", action="store_true", help="watch the run in Rerun (pip install 'improvo[view]')")
    parser.add_argument("--save", type=Path, metavar="FILE.rrd", help="record it for Rerun; works without a screen")
    parser.add_argument(
        "--report", action="store_true", help="write OUT/report.html at the end, as `improvo report` does"
    )
    parser.add_argument(
        "--scale",
        nargs="+",
        action="append",
        metavar="FROM",
        help=f"results in metres: {USAGE}; several distances by several --scale (default: up to scale)",
    )
    add_sequence_arguments(parser)
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Track the sequence and write the results; 130 after an interrupt, 3 where no frame has a pose."""
    extra = ["frontend.use_stability=false"] if arguments.no_stability else []
    extra += ["dense=true"] if arguments.dense else []
    extra += scale_settings(arguments.scale) if arguments.scale else []
    settings = settings_from(DenseRunSettings, arguments, extra=extra)
    from improvo.files import check_output_folder
    from improvo.folder_lock import working_in
    from improvo.frontend.registry import check_frontend
    from improvo.sequences import open_sequence

    check_frontend(settings.frontend.name, settings.frontend.network)
    check_output_folder(arguments.output, "run")
    settings = with_found_camera(settings, [arguments.sequence], arguments.output, "run")
    sequence = open_sequence(arguments.sequence, settings.sequence)
    if settings.dense:
        from improvo.depth.dense import refuse_live

        refuse_live(sequence)
    camera = sequence.camera
    frames = "live, Ctrl-C ends it: frames" if sequence.length is None else counted(sequence.length, "frame")
    say(
        f"{sequence.name}: {sequence.format}, {frames} of {camera.width}x{camera.height}; "
        f"frontend {settings.frontend.name}; poses and map are "
        + ("up to scale" if settings.scale.source == "none" else f"in metres, by {settings.scale.source}")
    )
    for note in sequence.notes:
        say(f"note: {note}")
    ask = _scale_source(sequence, settings)
    with working_in(arguments.output, "run"):
        return _tracked(arguments, sequence, settings, ask)


def _tracked(arguments: argparse.Namespace, sequence: Sequence, settings: DenseRunSettings, ask: Ask | None) -> int:
    """Everything that is written; 130 after an interrupt."""
    viewer = _viewer(arguments)
    summary = _track(sequence, arguments.output, settings, viewer)
    if ask is not None:
        from improvo.odometry.scale.apply import apply_scale

        summary = apply_scale(sequence, summary, ask, settings.scale)
    figures(_figures(summary), "")
    _print_summary(summary)
    interrupted = bool(summary.report["interrupted"])
    if settings.dense and not interrupted:
        interrupted = _add_depth(sequence, summary, settings)
    if arguments.report:
        from improvo.report.pages import write_report

        write_report(arguments.output, arguments.output / "report.html")
        next_step(f"open {arguments.output / 'report.html'}, or draw `improvo show labels {typed(arguments.output)}`")
    elif summary.tracked:
        next_step(
            f"`improvo report {typed(summary.folder)}` makes a page of it, "
            f"`improvo show map {typed(summary.folder)}` a picture"
        )
    else:
        next_step(f"`improvo info {recording_words(arguments.sequence)}` looks for what is wrong with the recording")
    if viewer is not None and viewer.failure is not None:
        raise viewer.failure
    if interrupted:
        return 130
    return 0 if summary.tracked else NO_RESULT


def _viewer(arguments: argparse.Namespace) -> RerunViewer | None:
    """Rerun where somebody wants to look."""
    if not arguments.view and arguments.save is None:
        return None
    from improvo.report.rerun_viewer import RerunViewer

    return RerunViewer(arguments.save)


def _scale_source(sequence: Sequence, settings: DenseRunSettings) -> Ask | None:
    """What will give the metres, looked for before any other work, with its progress."""
    if settings.scale.source == "none":
        return None
    from improvo.odometry.scale.sources import scale_source
    from improvo.terminal import progress

    with progress("markers", "frame", shown=settings.scale.source == "marker") as shown:
        return scale_source(sequence, settings.scale, shown.advance)


def _track(sequence: Sequence, folder: Path, settings: DenseRunSettings, viewer: RerunViewer | None) -> LabeledRun:
    """The run with its progress."""
    from improvo.labeling.labeler import run_and_label
    from improvo.odometry.run.compile import compile_odometry
    from improvo.self_calibration.found_cameras import with_camera_note
    from improvo.terminal import progress

    compile_odometry(notice)
    with progress("run", "frame", sequence.length) as shown:

        def told(frame: TrackedFrame) -> None:
            shown.note("no pose yet" if frame.cam_from_world is None else "")
            shown.advance()

        run = run_and_label(sequence, folder, settings, visualizer=viewer, progress=told, note=shown.note)
    return with_camera_note(run, settings.sequence.camera)


def _add_depth(sequence: Sequence, summary: LabeledRun, settings: DenseRunSettings) -> bool:
    """Depth maps and cloud with their progress; whether they were interrupted."""
    from improvo.depth.compile import compile_depth
    from improvo.depth.dense import write_dense
    from improvo.terminal import progress

    compile_depth(notice)
    with progress("depth", "frame", summary.tracked) as shown:
        entry = write_dense(sequence, summary, settings.depth, shown.advance)
    say(
        f"depth of {counted(entry['frames'], 'frame')} in depth.zip, {100 * entry['share']:.0f} % of their pixels; "
        f"{entry['points']} points in dense.ply"
    )
    return bool(entry["interrupted"])


def _figures(summary: LabeledRun) -> dict[str, Any]:
    report = summary.report
    names = ("frames", "segments", "points", "tracks", "events", "interrupted", "seconds", "frames_per_second", "scale")
    return {"folder": str(summary.folder), **{name: report[name] for name in names}, "metric": report.get("metric")}


def _scale_lines(report: dict[str, Any]) -> list[str]:
    """The scale of each segment, and how it changes."""
    if not report.get("metric"):
        return []
    lines = [f"unit: {report['scale']}"]
    for entry in report["metric"]["segments"]:
        error, change = entry["relative_error"], entry["change"]
        text = f"segment {entry['segment']}: {entry['metres_per_unit']:.5g} m a unit"
        text += "" if error is None else f", ±{100 * error:.2g} %"
        text += f", by {counted(entry['measurements'], 'measurement')}"
        text += "" if change is None else f"; {100 * change:+.1f} % from its first to its last third"
        lines.append(text)
    return lines


def _print_summary(summary: LabeledRun) -> None:
    from improvo.odometry.run.run_json import why_no_pose
    from improvo.odometry.verdict.told_verdicts import verdict_lines, what_doubt_means

    report = summary.report
    frames, segments = report["frames"], report["segments"]
    say(
        f"{frames['tracked']} of {counted(frames['processed'], 'frame')} have a pose, in "
        f"{counted(len(segments), 'segment')}; "
        f"{counted(report['points'], 'point')}; {report['frames_per_second']} frames/s"
    )
    for segment in segments[1:] if len(segments) > 1 else []:
        own = "" if report.get("metric") else "own scale, "
        say(f"  segment {segment['number']} starts at frame {segment['first']}: {own}placed by guess")
    for line in [*verdict_lines(report), *what_doubt_means(report), *_scale_lines(report)]:
        say(f"  {line}")
    warnings = [event for event in report["events"] if event["kind"] not in _UNSAID]
    for event in warnings[:_WARNINGS]:
        say(f"  frame {event['frame_index']}: {event['kind']}: {event['detail']}")
    if len(warnings) > _WARNINGS:
        say(f"  ... {len(warnings) - _WARNINGS} more in run.json")
    skipped = report["input"]["skipped"]
    if skipped:
        first = skipped[0]
        say(f"  {counted(len(skipped), 'frame')} could not be read, first {first['source']}: {first['reason']}")
    if report["interrupted"]:
        say("  interrupted: the result ends there, and is complete up to there")
    without = why_no_pose(report)
    say(f"results in {summary.folder}" if without is None else f"{without}; details in {summary.folder / 'run.json'}")
