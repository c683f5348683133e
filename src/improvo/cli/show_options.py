"""What the pictures of `improvo show` have in common: where they go, and which frames they take."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from improvo.errors import ConfigError, OutputError

if TYPE_CHECKING:
    from improvo.odometry.run_folder import RunFolder
    from improvo.sequences import Sequence
    from improvo.types import UInt8

_MANY = 20  # frames that deserve a progress bar
_LARGEST_SHEET = 60  # frames; more become files of their own


def chosen_positions(which: str, count: int) -> list[int]:
    """The frames that `--frames` names, of `count`.

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
        raise ConfigError(f"--frames {which}: give `all`, a list such as 10,50,90 (one: 10,), or a number of frames")
    if "," in which:
        wrong = [number for number in numbers if not 0 <= number < count]
        if wrong:
            raise ConfigError(f"--frames {which}: there is no frame {wrong[0]}; frames are 0 to {count - 1}")
        return numbers
    if numbers[0] < 1:
        raise ConfigError(f"--frames {which}: must be at least 1")
    spread = min(numbers[0], count)
    return [round((i + 0.5) * count / spread - 0.5) for i in range(spread)]  # the middles of equal parts


def target_path(output: Path | None, default_folder: Path, name: str) -> Path:
    """Where a picture goes: `output` as a file or folder, else `default_folder`, which is made.

    Raises:
        OutputError: it cannot be there.
    """
    if output is not None and output.suffix:
        if not output.parent.is_dir():
            raise OutputError(f"{output}: no folder {output.parent}; make it first")
        return output
    folder = output or default_folder
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made ({error.strerror}); choose another folder") from None
    return folder / name


def recorded_fps(run_folder: RunFolder) -> float:
    """Frames per second of the processed sequence."""
    first, last = (run_folder.report["input"][name] for name in ("first_time", "last_time"))
    return (run_folder.frames - 1) / (last - first) if first is not None and last > first else 30.0


def opened_sequence(arguments: argparse.Namespace) -> tuple[Sequence, str | None]:
    """The sequence of a command that takes a recording or the output folder of a run, and the run's frontend."""
    from improvo.cli.options import settings_from
    from improvo.odometry.run_folder import RunFolder
    from improvo.odometry.run_settings import RunSettings
    from improvo.sequences import open_sequence

    path: Path = arguments.sequence
    if (path / "run.json").is_file():
        run_folder = RunFolder(path)
        return run_folder.sequence, str(run_folder.report["configuration"]["frontend"]["name"])
    return open_sequence(path, settings_from(RunSettings, arguments, {}).sequence), None


def write_pictures(
    arguments: argparse.Namespace,
    default_folder: Path,
    positions: list[int],
    paint: Callable[[int], UInt8],
    fps: float,
) -> None:
    """The pictures of the chosen frames as one sheet, one PNG each, or a video, as the arguments say."""
    from tqdm import tqdm

    from improvo.files import write_png
    from improvo.report.sheets import write_sheet, write_video

    name = arguments.picture
    pictures = (paint(p) for p in tqdm(positions, unit="frame", desc=name, disable=len(positions) < _MANY))
    if arguments.video:
        target = target_path(arguments.output, default_folder, f"{name}.mp4")
        write_video(target, pictures, arguments.video_fps or fps)
    elif arguments.each or len(positions) > _LARGEST_SHEET:
        target = target_path(arguments.output, default_folder, name)
        target.mkdir(exist_ok=True)
        for position, picture in zip(positions, pictures, strict=True):
            write_png(target / f"{name}_{position:06d}.png", picture)
    else:
        target = target_path(arguments.output, default_folder, f"{name}.png")
        write_sheet(target, list(pictures))
    print(target)
