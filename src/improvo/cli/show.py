"""`improvo show PICTURE ...`: the paper's pictures, of a finished run, a recording or an evaluation."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from improvo.cli.options import add_config_arguments, add_sequence_arguments
from improvo.errors import InputError

if TYPE_CHECKING:
    from improvo.odometry.run_folder import RunFolder
    from improvo.report.track_pictures import FramePainter

_FRAME_PICTURES = {
    "tracks": "sparse flow over the image, coloured by the age of the track",
    "residuals": "re-projection errors over the image, blue low to red high",
    "labels": "stable, unstable and ignored points over the image",
}
_EVENLY = "6"  # frames of a sheet


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The pictures and their options."""
    pictures = parser.add_subparsers(dest="picture", metavar="PICTURE", required=True)
    overhead = _picture(pictures, "map", "trajectory and map from above", show_map)
    overhead.add_argument("--last", type=int, default=30, metavar="N", help="poses drawn in black: the last window")
    for name, help_line in _FRAME_PICTURES.items():
        frames = _picture(pictures, name, help_line, show_frames)
        frames.add_argument(
            "--sequence", type=Path, metavar="PATH", help="where the recording is now (default: where it was)"
        )
        _add_frames(frames)
    live = _picture(pictures, "live", "a finished run in Rerun: camera, frames, tracks, map by label", show_live)
    live.add_argument(
        "--sequence", type=Path, metavar="PATH", help="where the recording is now (default: where it was)"
    )
    live.add_argument("--no-images", action="store_true", help="leave out the frames, which need the recording")
    _add_recording_pictures(pictures)
    accuracy = _picture(pictures, "accuracy", "pose accuracy against threshold, of several frontends", show_accuracy)
    accuracy.add_argument("--estimator", help="only this solver (default: one picture for each)")


def _add_recording_pictures(pictures: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """The pictures that need a recording and frontends, not a run."""
    stability = _picture(pictures, "stability", "dense stability over the image", show_stability, of_run=False)
    stability.add_argument("--frontend", metavar="NAME", help="network with a stability head (default: the run's)")
    _add_frames(stability)
    matches = _picture(pictures, "matches", "two frontends on one image pair", show_matches, of_run=False)
    matches.add_argument("--frontends", default="superpoint-vo,sift", metavar="A,B", help="one row of panels each")
    matches.add_argument("--pair", default="0,30", metavar="A,B", help="the two frames")
    matches.add_argument("--max-keypoints", type=int, default=500, metavar="N", help="per frame")
    for parser in (stability, matches):
        add_sequence_arguments(parser)
        add_config_arguments(parser)


def _picture(
    pictures: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    help_line: str,
    function: Callable[[argparse.Namespace], None],
    of_run: bool = True,
) -> argparse.ArgumentParser:
    parser = pictures.add_parser(
        name, help=help_line, description=help_line, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    if of_run:
        made_by = "improvo evaluate pose" if name == "accuracy" else "improvo run"
        parser.add_argument("folder", type=Path, metavar="OUT", help=f"output folder of `{made_by}`")
        default = f"OUT/pictures/{name}.png"
    else:
        parser.add_argument("sequence", type=Path, metavar="SEQUENCE", help="a recording, or the folder of a run")
        default = f"./{name}.png"
    where = "file to record (default: open the viewer)" if name == "live" else f"file or folder (default: {default})"
    parser.add_argument("-o", "--output", "--save", type=Path, metavar="PATH", help=where)
    if name != "accuracy":
        parser.add_argument("--palette", choices=("paper", "colour-blind"), default="paper", help="of the picture")
    parser.set_defaults(show=function)
    return parser


def _add_frames(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--frames", default=_EVENLY, metavar="WHICH", help="`all`, a list such as 10,50,90, or N for N spread evenly"
    )
    parser.add_argument("--each", action="store_true", help="one PNG per frame, not one sheet")
    parser.add_argument("--video", action="store_true", help="one MP4 (of all frames, unless --frames says else)")
    parser.add_argument("--video-fps", type=float, metavar="FPS", help="of the video (default: as recorded)")


def run(arguments: argparse.Namespace) -> None:
    """Draw the chosen picture."""
    arguments.show(arguments)


def show_map(arguments: argparse.Namespace) -> None:
    """`improvo show map`."""
    from improvo.cli.show_options import target_path
    from improvo.odometry.run_folder import RunFolder
    from improvo.report.map_picture import draw_map
    from improvo.report.palettes import palette

    run_folder = RunFolder(arguments.folder)
    target = target_path(arguments.output, arguments.folder / "pictures", "map.png")
    draw_map(run_folder, target, palette(arguments.palette), arguments.last)
    print(target)


def show_frames(arguments: argparse.Namespace) -> None:
    """`improvo show tracks`, `residuals` and `labels`: a sheet, PNG files or a video."""
    from functools import partial

    from improvo.cli.show_options import chosen_positions, recorded_fps, write_pictures
    from improvo.odometry.run_folder import RunFolder
    from improvo.report import track_pictures
    from improvo.report.palettes import palette

    settings = track_pictures.TrackPictureSettings(palette=palette(arguments.palette))
    painters: dict[str, FramePainter] = {
        "tracks": partial(track_pictures.paint_tracks, settings=settings),
        "residuals": partial(track_pictures.paint_residuals, settings=settings),
        "labels": partial(track_pictures.paint_labels, settings=settings),
    }
    run_folder: RunFolder = RunFolder(arguments.folder, arguments.sequence)
    painter = painters[arguments.picture]
    positions = chosen_positions(_which(arguments), run_folder.frames)
    folder = arguments.folder / "pictures"
    write_pictures(arguments, folder, positions, lambda p: painter(run_folder, p), recorded_fps(run_folder))


def show_stability(arguments: argparse.Namespace) -> None:
    """`improvo show stability`."""
    from improvo.cli.show_options import chosen_positions, opened_sequence, write_pictures
    from improvo.frontend.network import NetworkFrontend
    from improvo.frontend.registry import load_frontend
    from improvo.report.palettes import palette
    from improvo.report.stability_picture import paint_stability

    sequence, frontend_of_run = opened_sequence(arguments)
    name = arguments.frontend or frontend_of_run or "superpoint-vo"
    frontend = load_frontend(name)
    if not isinstance(frontend, NetworkFrontend):
        raise InputError(f"{name}: has no stability head; name a network that has one with --frontend")
    colours, shown_name = palette(arguments.palette), Path(name).stem
    positions = chosen_positions(_which(arguments), len(sequence))
    times = sequence.times
    fps = (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 30.0
    write_pictures(
        arguments,
        Path(),
        positions,
        lambda p: paint_stability(sequence[p].image, frontend, f"frame {p}, {shown_name}", colours),
        fps,
    )


def show_matches(arguments: argparse.Namespace) -> None:
    """`improvo show matches`."""
    import numpy as np

    from improvo.cli.show_options import chosen_positions, opened_sequence, target_path
    from improvo.files import write_png
    from improvo.frontend.registry import load_frontend
    from improvo.report.match_picture import paint_matches
    from improvo.report.palettes import palette

    sequence, _ = opened_sequence(arguments)
    pair = chosen_positions(arguments.pair, len(sequence))
    if len(pair) != 2 or "," not in arguments.pair:
        raise InputError(f"--pair {arguments.pair}: give two frames, such as 0,30")
    image_a, image_b = (sequence[position].image for position in pair)
    depth_a = sequence.depth(pair[0])
    rows = [
        paint_matches(
            load_frontend(name, arguments.max_keypoints, opencv_defaults=True),
            image_a,
            image_b,
            depth_a,
            sequence.camera,
            palette(arguments.palette),
        )
        for name in arguments.frontends.split(",")
    ]
    target = target_path(arguments.output, Path(), "matches.png")
    write_png(target, np.concatenate(rows))
    print(target)


def show_live(arguments: argparse.Namespace) -> None:
    """`improvo show live`."""
    from improvo.odometry.run_folder import RunFolder
    from improvo.report.palettes import palette
    from improvo.report.rerun_viewer import show_run

    run_folder = RunFolder(arguments.folder, arguments.sequence)
    show_run(run_folder, arguments.output, palette(arguments.palette), images=not arguments.no_images)
    if arguments.output:
        print(arguments.output)


def show_accuracy(arguments: argparse.Namespace) -> None:
    """`improvo show accuracy`."""
    from improvo.cli.evaluate_pose import read_results
    from improvo.cli.show_options import target_path
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
        print(target)


def _which(arguments: argparse.Namespace) -> str:
    return "all" if arguments.video and arguments.frames == _EVENLY else arguments.frames
