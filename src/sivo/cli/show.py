"""`sivo show PICTURE OUT`: the paper's pictures of a finished run."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from sivo.errors import ConfigError, OutputError

if TYPE_CHECKING:
    from sivo.report.run_folder import RunFolder
    from sivo.report.track_pictures import FramePainter

_FRAME_PICTURES = {
    "tracks": "sparse flow over the image, coloured by the age of the track",
    "residuals": "re-projection errors over the image, blue low to red high",
    "labels": "stable, unstable and ignored points over the image",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The pictures and their options."""
    pictures = parser.add_subparsers(dest="picture", metavar="PICTURE", required=True)
    overhead = _picture(pictures, "map", "trajectory and map from above", show_map)
    overhead.add_argument("--last", type=int, default=30, metavar="N", help="poses drawn in black: the last window")
    for name, help_line in _FRAME_PICTURES.items():
        frames = _picture(pictures, name, help_line, show_frames)
        frames.add_argument(
            "--frames", default="6", metavar="WHICH", help="`all`, a list such as 10,50,90, or N for N spread evenly"
        )
        frames.add_argument("--each", action="store_true", help="one PNG per frame, not one sheet")
        frames.add_argument("--video", action="store_true", help="one MP4 (of all frames, unless --frames says else)")
        frames.add_argument("--fps", type=float, help="of the video (default: as recorded)")
        frames.add_argument(
            "--sequence", type=Path, metavar="PATH", help="where the recording is now (default: where it was)"
        )


def _picture(
    pictures: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    help_line: str,
    function: Callable[[argparse.Namespace], None],
) -> argparse.ArgumentParser:
    parser = pictures.add_parser(
        name, help=help_line, description=help_line, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("folder", type=Path, metavar="OUT", help="output folder of `sivo run`")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="PATH", help=f"file or folder (default: OUT/pictures/{name}.png)"
    )
    parser.add_argument("--palette", choices=("paper", "colour-blind"), default="paper", help="of the picture")
    parser.set_defaults(show=function)
    return parser


def run(arguments: argparse.Namespace) -> None:
    """Draw the chosen picture."""
    arguments.show(arguments)


def show_map(arguments: argparse.Namespace) -> None:
    """`sivo show map`."""
    from sivo.report.map_picture import draw_map
    from sivo.report.palettes import palette
    from sivo.report.run_folder import RunFolder

    run_folder = RunFolder(arguments.folder)
    target = _target(arguments, "map.png")
    draw_map(run_folder, target, palette(arguments.palette), arguments.last)
    print(target)


def show_frames(arguments: argparse.Namespace) -> None:
    """`sivo show tracks`, `residuals` and `labels`: a sheet, PNG files or a video."""
    from functools import partial

    from sivo.report import track_pictures
    from sivo.report.palettes import palette
    from sivo.report.run_folder import RunFolder

    settings = track_pictures.TrackPictureSettings(palette=palette(arguments.palette))
    painters: dict[str, FramePainter] = {
        "tracks": partial(track_pictures.paint_tracks, settings=settings),
        "residuals": partial(track_pictures.paint_residuals, settings=settings),
        "labels": partial(track_pictures.paint_labels, settings=settings),
    }
    run_folder = RunFolder(arguments.folder, arguments.sequence)
    _write(arguments, run_folder, painters[arguments.picture])


def _write(arguments: argparse.Namespace, run_folder: RunFolder, painter: FramePainter) -> None:
    """The pictures of the chosen frames, in the chosen form."""
    from tqdm import tqdm

    from sivo.report.sheets import write_png, write_sheet, write_video

    chosen = "all" if arguments.video and arguments.frames == "6" else arguments.frames
    positions = _positions(chosen, run_folder.frames)
    progress = tqdm(positions, unit="frame", desc=arguments.picture, disable=len(positions) < 20)
    pictures = (painter(run_folder, position) for position in progress)
    if arguments.video:
        target = _target(arguments, f"{arguments.picture}.mp4")
        write_video(target, pictures, arguments.fps or _recorded_fps(run_folder))
    elif arguments.each or len(positions) > 60:
        target = _target(arguments, arguments.picture)
        target.mkdir(exist_ok=True)
        for position, picture in zip(positions, pictures, strict=True):
            write_png(target / f"{arguments.picture}_{position:06d}.png", picture)
    else:
        target = _target(arguments, f"{arguments.picture}.png")
        write_sheet(target, list(pictures))
    print(target)


def _positions(which: str, count: int) -> list[int]:
    """The frames that `--frames` names."""
    if which == "all":
        return list(range(count))
    try:
        numbers = [int(word) for word in which.split(",")]
    except ValueError:
        raise ConfigError(f"--frames {which}: give `all`, a list such as 10,50,90, or a number of frames") from None
    if "," in which:
        wrong = [number for number in numbers if not 0 <= number < count]
        if wrong:
            raise ConfigError(f"--frames {which}: the run has no frame {wrong[0]}; frames are 0 to {count - 1}")
        return numbers
    if numbers[0] < 1:
        raise ConfigError(f"--frames {which}: must be at least 1")
    spread = min(numbers[0], count)
    return [round((i + 0.5) * count / spread - 0.5) for i in range(spread)]  # the middles of equal parts


def _recorded_fps(run_folder: RunFolder) -> float:
    """Frames per second of the processed sequence."""
    first, last = (run_folder.report["input"][name] for name in ("first_time", "last_time"))
    return (run_folder.frames - 1) / (last - first) if first is not None and last > first else 30.0


def _target(arguments: argparse.Namespace, name: str) -> Path:
    """Where to write: `--output` as a file or folder, else OUT/pictures."""
    output: Path | None = arguments.output
    if output is None:
        output = arguments.folder / "pictures"
    elif output.suffix:
        folder = output.parent
        if not folder.is_dir():
            raise OutputError(f"{output}: no folder {folder}; make it first")
        return output
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{output}: cannot be made ({error.strerror}); choose another folder") from None
    return output / name
