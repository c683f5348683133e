"""What the pictures of `improvo show` have in common: their options, where they go, and which frames they take."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from improvo.cli.output import say
from improvo.errors import ConfigError, InputError, OutputError
from improvo.files import check_output_file
from improvo.terminal import counted

if TYPE_CHECKING:
    from improvo.odometry.run.run_folder import RunFolder
    from improvo.types import UInt8

_EVENLY = "6"  # frames of a sheet
_MANY = 20  # frames that deserve a progress bar
_FASTEST = 1000.0  # pictures a second of a video
_LARGEST_SHEET = 60  # frames; more become files of their own
_PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
MOVING = (".mp4", ".webm", ".gif", ".webp")  # suffixes of `improvo.report.sheets`, which loads more


def add_run_folder(parser: argparse.ArgumentParser, made_by: str = "run") -> None:
    """The output folder that a picture is made of."""
    parser.add_argument("folder", type=Path, metavar="OUT", help=f"output folder of `improvo {made_by}`")


def add_recording(parser: argparse.ArgumentParser, name: str = "sequence") -> None:
    """Where the recording of a run is now, as the argument `name`."""
    parser.add_argument(
        "--sequence",
        dest=name,
        type=Path,
        metavar="PATH",
        help="where the recording of a run is now (default: where it was)",
    )


def add_target(parser: argparse.ArgumentParser, default: str) -> None:
    """Where the picture goes."""
    parser.add_argument(
        "-o", "--output", "--save", type=Path, metavar="PATH", help=f"file or folder (default: {default})"
    )


def add_palette(parser: argparse.ArgumentParser) -> None:
    """The colours."""
    parser.add_argument("--palette", choices=("paper", "colour-blind"), default="paper", help="of the pictures")


def add_frames(parser: argparse.ArgumentParser) -> None:
    """Which frames, and whether as a sheet, files or a video."""
    parser.add_argument(
        "--frames", default=_EVENLY, metavar="WHICH", help="`all`, a list such as 10,50,90, or N for N spread evenly"
    )
    parser.add_argument("--each", action="store_true", help="one PNG per frame, not one sheet")
    parser.add_argument(
        "--video",
        action="store_true",
        help="one MP4 (of all frames, unless --frames says else); as does -o FILE.mp4, .webm, .gif or .webp",
    )
    parser.add_argument("--video-fps", type=float, metavar="FPS", help="of the video (default: as recorded)")
    parser.add_argument("--video-width", type=int, metavar="PIXELS", help="of the video (default: of the pictures)")


def asked_frames(arguments: argparse.Namespace, count: int) -> list[int]:
    """The frames that the arguments of `add_frames` name, of `count`; what they say of the output is checked too."""
    video = _is_video(arguments)
    if count == 0:
        raise InputError(f"{vars(arguments).get('folder') or arguments.sequence}: has no frames to draw")
    which = "all" if video and arguments.frames == _EVENLY else arguments.frames
    frames = chosen_frames(which, count)
    output: Path | None = arguments.output
    if arguments.video_width is not None and arguments.video_width < 16:
        raise ConfigError(f"--video-width {arguments.video_width}: must be at least 16 pixels")
    if arguments.video_fps is not None and not 0 < arguments.video_fps <= _FASTEST:
        raise ConfigError(f"--video-fps {arguments.video_fps:g}: must be positive, and at most {_FASTEST:g}")
    if output is None or not output.suffix or video:
        return frames
    if arguments.each or len(frames) > _LARGEST_SHEET:
        raise OutputError(
            f"{output}: {counted(len(frames), 'picture')} {'is' if len(frames) == 1 else 'are'} a file each; name a "
            f"folder, or a video (.mp4), or at most {_LARGEST_SHEET} frames for one sheet"
        )
    return frames


def _is_video(arguments: argparse.Namespace) -> bool:
    output: Path | None = arguments.output
    return bool(arguments.video or (output is not None and output.suffix.lower() in MOVING))


def chosen_frames(which: str, count: int, flag: str = "--frames") -> list[int]:
    """The frames that a flag names, of `count`.

    Raises:
        ConfigError: no such frames.
    """
    if which == "all":
        return list(range(count))
    try:
        numbers = [int(word) for word in which.split(",") if word.strip()]
    except ValueError:
        numbers = []
    if not numbers:
        raise ConfigError(f"{flag} {which}: give `all`, a list such as 10,50,90 (one: 10,), or a number of frames")
    if "," in which:
        wrong = [number for number in numbers if not 0 <= number < count]
        if wrong:
            raise ConfigError(f"{flag} {which}: there is no frame {wrong[0]}; frames are 0 to {count - 1}")
        return numbers
    if numbers[0] < 1:
        raise ConfigError(f"{flag} {which}: must be at least 1")
    spread = min(numbers[0], count)
    return [round((i + 0.5) * count / spread - 0.5) for i in range(spread)]  # the middles of equal parts


def target_path(
    output: Path | None, default_folder: Path, name: str, suffixes: Collection[str] = (*_PICTURES, *MOVING)
) -> Path:
    """Where a picture or page goes: `output` as a file or folder, else `default_folder`. Nothing is made yet.

    Args:
        output, default_folder, name: as above; the name in a folder.
        suffixes: of such files; one that exists under another is not replaced.

    Raises:
        OutputError: it cannot be there.
    """
    if output is not None and output.suffix and not output.is_dir():
        check_output_file(output, suffixes)
        if not output.parent.is_dir():
            raise OutputError(f"{output}: no folder {output.parent}; make it first")
        return output
    folder = output or default_folder
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file, not a folder; choose another folder")
    return folder / name


def recorded_fps(run_folder: RunFolder) -> float:
    """Frames per second of the processed sequence."""
    first, last = (run_folder.report["input"][name] for name in ("first_time", "last_time"))
    return (run_folder.frames - 1) / (last - first) if first is not None and last > first else 30.0


def write_pictures(
    arguments: argparse.Namespace,
    default_folder: Path,
    frames: list[int],
    paint: Callable[[int], UInt8],
    fps: float,
) -> None:
    """The pictures of the chosen frames as one sheet, one PNG each, or a video, as the arguments say.

    Args:
        arguments: of `add_frames` and `add_target`.
        default_folder: where they go without --output.
        frames: to draw.
        paint: the picture of a frame.
        fps: of a video.
    """
    from improvo.files import write_png
    from improvo.report.sheets import write_sheet, write_video
    from improvo.terminal import progress

    name = arguments.part
    unreadable: list[InputError] = []
    with progress(name, "frame", len(frames), shown=len(frames) >= _MANY) as shown:

        def painted() -> Iterator[tuple[int, UInt8]]:
            for frame in frames:
                shown.advance()
                try:
                    picture = paint(frame)
                except InputError as error:
                    unreadable.append(error)
                    if "," in arguments.frames or len(unreadable) == len(frames):  # asked for, or none is left
                        raise
                    continue
                yield frame, picture

        numbered = painted()
        pictures = (picture for _, picture in numbered)
        if _is_video(arguments):
            target = target_path(arguments.output, default_folder, f"{name}.mp4")
            write_video(target, pictures, arguments.video_fps or fps, arguments.video_width)
        elif arguments.each or len(frames) > _LARGEST_SHEET:
            target = target_path(arguments.output, default_folder, name)
            for frame, picture in numbered:
                write_png(target / f"{name}_{frame:06d}.png", picture)
        else:
            target = target_path(arguments.output, default_folder, f"{name}.png")
            write_sheet(target, list(pictures))
    if unreadable:
        say(f"without {counted(len(unreadable), 'frame')}: {unreadable[0]}")
    say(str(target))
