"""Render rooms with exact depth, poses and causes of instability, in the layout of TUM RGB-D (extra `simulate`)."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from improvo.cli.flags import add_setting
from improvo.cli.options import add_config_arguments, settings_from
from improvo.cli.output import figures, next_step, typed
from improvo.simulation.settings import SimulationSettings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo simulate`."""
    defaults = SimulationSettings()
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="SEQUENCE", help="folder for the recording")
    add_setting(parser, defaults, "--frames", "frames")
    add_setting(parser, defaults, "--seed", "seed")
    add_setting(parser, defaults, "--fps", "fps")
    size = f"{defaults.width}x{defaults.height}"
    parser.add_argument("--size", default=argparse.SUPPRESS, metavar="WxH", help=f"of the images (default: {size})")
    parser.add_argument("--grey", action="store_true", help="write grey images")
    parser.add_argument("--jpeg", type=int, metavar="QUALITY", help="write JPEG images (default: PNG)")
    parser.add_argument("--depth-every", type=int, default=1, metavar="N", help="write the depth of every n-th frame")
    parser.add_argument("--scenes", type=int, default=1, metavar="N", help="so many recordings, with rising seeds")
    parser.add_argument("--workers", type=int, default=1, metavar="M", help="processes that render them")
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> None:
    """Render, with a progress bar."""
    from improvo.files import check_output_folder
    from improvo.simulation.generate import simulate, simulate_many
    from improvo.terminal import progress

    settings, place = _settings(arguments), typed(arguments.output)
    check_output_folder(arguments.output, "simulate")
    common: dict[str, Any] = {"jpeg_quality": arguments.jpeg, "depth_every": arguments.depth_every}
    measures = {name: getattr(settings, name) for name in ("frames", "width", "height", "fps", "fov", "seed")}
    if arguments.scenes == 1:
        with progress("simulate", "frame", settings.frames) as shown:
            simulate(settings, arguments.output, **common, progress=shown.advance)
        figures(
            {"folders": [str(arguments.output)], **measures},
            f"{arguments.output}: {settings.frames} frames of {settings.width}x{settings.height}, seed {settings.seed}",
        )
        next_step(f"`improvo run {place} -o out`, `improvo evaluate trajectory out {place}`")
        return
    with progress("simulate", "scene", arguments.scenes) as shown:
        folders = simulate_many(
            settings, arguments.output, arguments.scenes, arguments.workers, **common, progress=shown.advance
        )
    figures(
        {"folders": [str(folder) for folder in folders], **measures},
        f"{arguments.output}: {len(folders)} recordings, {folders[0].name} to {folders[-1].name}",
    )
    next_step(f"`improvo label {place}/* -o labels`")


def _settings(arguments: argparse.Namespace) -> SimulationSettings:
    """Preset, file, --set, then the flags."""
    from improvo.errors import ConfigError

    for name in ("scenes", "workers", "depth_every"):
        if getattr(arguments, name) < 1:
            raise ConfigError(f"--{name.replace('_', '-')}: must be at least 1")
    if arguments.jpeg is not None and not 1 <= arguments.jpeg <= 100:
        raise ConfigError(f"--jpeg {arguments.jpeg}: must be from 1 to 100")
    settings = settings_from(SimulationSettings, arguments)
    changes: dict[str, Any] = {}
    if hasattr(arguments, "size"):
        width, _, height = arguments.size.partition("x")
        if not all(side.isdecimal() and len(side) < 9 for side in (width, height)):
            raise ConfigError(f"--size {arguments.size}: write it as WIDTHxHEIGHT, such as 640x480")
        changes |= {"width": int(width), "height": int(height)}
    if arguments.grey:
        changes["colour"] = False
    return replace(settings, **changes)
