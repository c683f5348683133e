"""`improvo show map`, `tracks`, `residuals`, `labels`, `live`, `accuracy`: pictures of a finished run or evaluation."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from improvo.cli.output import next_step, say, typed
from improvo.cli.show_options import (
    add_frames,
    add_palette,
    add_recording,
    add_run_folder,
    add_target,
    asked_frames,
    recorded_fps,
    target_path,
    write_pictures,
)
from improvo.errors import ConfigError, InputError

if TYPE_CHECKING:
    from improvo.report.track_pictures import FramePainter


def add_map_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo show map`."""
    add_run_folder(parser)
    add_target(parser, "OUT/pictures/map.png")
    add_palette(parser)
    add_recording(parser)
    parser.add_argument("--last", type=int, default=30, metavar="N", help="poses drawn in black: the last window")


def run_map(arguments: argparse.Namespace) -> None:
    """Trajectory and map from above."""
    from improvo.odometry.run.run_folder import RunFolder
    from improvo.report.map_picture import draw_map
    from improvo.report.palettes import palette

    if arguments.last < 1:
        raise ConfigError(f"--last {arguments.last}: must be at least 1")
    run_folder = RunFolder(arguments.folder, arguments.sequence)
    target = target_path(arguments.output, arguments.folder / "pictures", "map.png")
    draw_map(run_folder, target, palette(arguments.palette), arguments.last)
    say(str(target))
    next_step(f"open it, or `improvo report {typed(arguments.folder)}` for a page with all pictures")


def add_frames_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo show tracks`, `residuals` and `labels`."""
    add_run_folder(parser)
    add_target(parser, "OUT/pictures")
    add_palette(parser)
    add_recording(parser)
    add_frames(parser)


def run_frames(arguments: argparse.Namespace) -> None:
    """A sheet, PNG files or a video of tracks, residuals or labels."""
    from functools import partial

    from improvo.odometry.run.run_folder import RunFolder
    from improvo.report import track_pictures
    from improvo.report.palettes import palette

    settings = track_pictures.TrackPictureSettings(palette=palette(arguments.palette))
    painters: dict[str, FramePainter] = {
        "tracks": partial(track_pictures.paint_tracks, settings=settings),
        "residuals": partial(track_pictures.paint_residuals, settings=settings),
        "labels": partial(track_pictures.paint_labels, settings=settings),
    }
    run_folder = RunFolder(arguments.folder, arguments.sequence)
    painter = painters[arguments.part]
    frames = asked_frames(arguments, run_folder.frames)
    folder = arguments.folder / "pictures"
    write_pictures(arguments, folder, frames, lambda frame: painter(run_folder, frame), recorded_fps(run_folder))
    next_step(f"open it, or `improvo report {typed(arguments.folder)}` for a page with all pictures")


def add_live_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo show live`."""
    add_run_folder(parser)
    parser.add_argument(
        "-o", "--output", "--save", type=Path, metavar="FILE.rrd", help="file to record (default: open the viewer)"
    )
    add_palette(parser)
    add_recording(parser)
    parser.add_argument("--no-images", action="store_true", help="leave out the frames, which need the recording")


def run_live(arguments: argparse.Namespace) -> None:
    """A finished run in Rerun."""
    from improvo.odometry.run.run_folder import RunFolder
    from improvo.report.palettes import palette
    from improvo.report.rerun_viewer import show_run

    run_folder = RunFolder(arguments.folder, arguments.sequence)
    show_run(run_folder, arguments.output, palette(arguments.palette), images=not arguments.no_images)
    if arguments.output:
        say(str(arguments.output))
        next_step(f"`rerun {typed(arguments.output)}` opens it")


def add_accuracy_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo show accuracy`."""
    add_run_folder(parser, "evaluate pose")
    add_target(parser, "OUT/pictures/accuracy-SOLVER.png")
    parser.add_argument("--estimator", help="only this solver (default: one picture for each)")


def run_accuracy(arguments: argparse.Namespace) -> None:
    """Accuracy against threshold."""
    from improvo.cli.evaluate_pose import read_results
    from improvo.evaluation.plots import draw_pose_curves

    results = read_results(arguments.folder / "pose.json")
    known = results["settings"]["estimators"]
    if arguments.estimator is not None and arguments.estimator not in known:
        raise InputError(f"--estimator {arguments.estimator}: not in pose.json; it has {', '.join(known)}")
    for estimator in [arguments.estimator] if arguments.estimator else known:
        target = target_path(arguments.output, arguments.folder / "pictures", f"accuracy-{estimator}.png")
        if len(known) > 1 and arguments.estimator is None and target == arguments.output:
            target = target.with_stem(f"{target.stem}-{estimator}")
        draw_pose_curves(results, estimator, target)
        say(str(target))
    next_step(f"open it, or `improvo report {typed(arguments.folder)}` for a page with the tables")
