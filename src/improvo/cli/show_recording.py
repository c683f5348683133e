"""`improvo show stability` and `improvo show matches`: what networks and frontends make of a recording."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from improvo.cli.auto_camera import with_found_camera
from improvo.cli.options import add_config_arguments, add_sequence_arguments, recording_path, settings_from
from improvo.cli.output import next_step, say
from improvo.cli.show_options import (
    add_frames,
    add_palette,
    add_recording,
    add_target,
    asked_frames,
    chosen_frames,
    target_path,
    write_pictures,
)
from improvo.errors import ConfigError, InputError

if TYPE_CHECKING:
    from improvo.sequences import Sequence
    from improvo.types import UInt8


def add_stability_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo show stability`."""
    _add_recording(parser, "./stability.png")
    parser.add_argument("--frontend", metavar="NAME", help="network with a stability head (default: the run's)")
    add_frames(parser)
    add_sequence_arguments(parser)
    add_config_arguments(parser)


def run_stability(arguments: argparse.Namespace) -> None:
    """Dense stability over the image."""
    from improvo.frontend.network import NetworkFrontend
    from improvo.frontend.registry import load_frontend
    from improvo.frontend.settings import DEFAULT_FRONTEND
    from improvo.report.palettes import palette
    from improvo.report.stability_picture import paint_stability

    sequence, frontend_of_run = _opened_sequence(arguments)
    name = arguments.frontend or frontend_of_run or DEFAULT_FRONTEND
    frontend = load_frontend(name)
    if not isinstance(frontend, NetworkFrontend):
        raise InputError(f"{name}: has no stability head; name a network that has one with --frontend")
    colours, shown_name = palette(arguments.palette), Path(name).stem
    frames = asked_frames(arguments, len(sequence))
    times = sequence.times
    fps = float((len(times) - 1) / (times[-1] - times[0])) if len(times) > 1 and times[-1] > times[0] else 30.0

    def painted(number: int) -> UInt8:
        frame = sequence[number]
        return paint_stability(frame.image, frontend, f"frame {number}, {shown_name}", colours, mask=frame.mask)

    write_pictures(arguments, Path(), frames, painted, fps)
    next_step("open it")


def add_matches_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo show matches`."""
    _add_recording(parser, "./matches.png")
    parser.add_argument("--frontends", default="superpoint-vo,sift", metavar="A,B", help="one row of panels each")
    parser.add_argument("--pair", default="0,+1s", metavar="A,B", help="the two frames; +5 frames or +1s after A for B")
    parser.add_argument("--max-keypoints", type=int, default=500, metavar="N", help="per frame")
    add_sequence_arguments(parser)
    add_config_arguments(parser)


def run_matches(arguments: argparse.Namespace) -> None:
    """Two frontends on one image pair."""
    import numpy as np

    from improvo.files import write_png
    from improvo.frontend.registry import check_frontend, load_frontend
    from improvo.report.match_picture import paint_matches
    from improvo.report.palettes import palette

    names = arguments.frontends.split(",")
    for name in names:
        check_frontend(name)
    sequence, _ = _opened_sequence(arguments)
    pair = _pair(arguments.pair, sequence)
    frame_a, frame_b = (sequence[frame] for frame in pair)
    depth_a = sequence.depth(pair[0])
    rows = [
        paint_matches(
            load_frontend(name, arguments.max_keypoints, opencv_defaults=True),
            frame_a.image,
            frame_b.image,
            depth_a,
            sequence.camera,
            palette(arguments.palette),
            masks=(frame_a.mask, frame_b.mask),
        )
        for name in names
    ]
    target = target_path(arguments.output, Path(), "matches.png")
    write_png(target, np.concatenate(rows))
    say(str(target))
    next_step("open it")


def _pair(text: str, sequence: Sequence) -> list[int]:
    """The two frames that `--pair` names.

    Raises:
        InputError: it names no two frames. ConfigError: there is no such frame.
    """
    mend = InputError(f"--pair {text}: give two frames, such as 0,30, or 0,+5 (frames later), or 0,+1s (seconds later)")
    first, comma, second = text.partition(",")
    if not comma or not first.strip().isdecimal():
        raise mend
    if second.startswith("+"):
        second = str(_later(int(first), second[1:], sequence, mend))
    frames = chosen_frames(f"{first},{second}", len(sequence), "--pair")
    if len(frames) != 2:
        raise mend
    return frames


def _later(first: int, words: str, sequence: Sequence, mend: InputError) -> int:
    """The frame so many frames, or seconds, after the first one: the nearest in time, and one at least."""
    import numpy as np

    try:
        later = float(words[:-1]) if words.endswith("s") else int(words)
    except ValueError:
        raise mend from None
    if not 0 < later < float("inf"):
        raise mend
    if isinstance(later, int) or first >= len(sequence) - 1:
        return first + int(later)
    times = sequence.times
    step = float(np.median(np.diff(times)))
    beyond = round((times[first] + later - times[-1]) / step)
    if beyond > 0:
        return len(times) - 1 + beyond
    return max(first + 1, int(np.argmin(np.abs(times - (times[first] + later)))))


def _add_recording(parser: argparse.ArgumentParser, default: str) -> None:
    parser.add_argument("sequence", type=recording_path, metavar="SEQUENCE", help="a recording, or the folder of a run")
    add_target(parser, default)
    add_palette(parser)
    add_recording(parser, "recording")


def _opened_sequence(arguments: argparse.Namespace) -> tuple[Sequence, str | None]:
    """The sequence of a command that takes a recording or the output folder of a run, and the run's frontend."""
    from improvo.odometry.run.run_folder import RunFolder
    from improvo.odometry.run_settings import RunSettings
    from improvo.sequences import open_sequence

    path: Path = arguments.sequence
    if (path / "run.json").is_file():
        _refuse_reading_otherwise(path, arguments)
        run_folder = RunFolder(path, arguments.recording)
        return run_folder.sequence, str(run_folder.report["configuration"]["frontend"]["name"])
    if arguments.recording is not None:
        raise ConfigError(f"--sequence {arguments.recording}: belongs to the folder of a run, and {path} is none")
    settings = with_found_camera(settings_from(RunSettings, arguments), [path], None, "show")
    return open_sequence(path, settings.sequence), None


def _refuse_reading_otherwise(run: Path, arguments: argparse.Namespace) -> None:
    """A run's recording is read as it was for the run.

    Raises:
        ConfigError: an option says otherwise.
    """
    given = [f"--{name.replace('_', '-')}" for name in arguments.flags if hasattr(arguments, name)]
    given += [f"--{name}" for name in ("config", "set", "preset") if getattr(arguments, name, None)]
    if given:
        raise ConfigError(f"{given[0]}: {run} is a run, whose recording is read as it was then; name the recording")
