"""`improvo simulate -o SEQUENCE`."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from improvo.simulation.settings import PRESETS, SimulationSettings, preset

_FLAGS = ("frames", "seed", "fps")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo simulate`."""
    defaults = SimulationSettings()
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="SEQUENCE", help="folder for the recording")
    parser.add_argument("--preset", choices=PRESETS, default="home", help="how difficult")
    for name in _FLAGS:
        value = getattr(defaults, name)
        parser.add_argument(
            f"--{name}", type=type(value), default=argparse.SUPPRESS, metavar="N", help=f"(default: {value})"
        )
    size = f"{defaults.width}x{defaults.height}"
    parser.add_argument("--size", default=argparse.SUPPRESS, metavar="WxH", help=f"of the images (default: {size})")
    parser.add_argument("--grey", action="store_true", help="write grey images")
    parser.add_argument("--jpeg", type=int, metavar="QUALITY", help="write JPEG images (default: PNG)")
    parser.add_argument("--depth-every", type=int, default=1, metavar="N", help="write the depth of every n-th frame")
    parser.add_argument("--scenes", type=int, default=1, metavar="N", help="so many recordings, with rising seeds")
    parser.add_argument("--workers", type=int, default=1, metavar="M", help="processes that render them")
    parser.add_argument("--config", type=Path, metavar="FILE", help="settings as YAML, instead of a preset")
    parser.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="any other setting, such as walkers=2"
    )


def run(arguments: argparse.Namespace) -> None:
    """Render, with a progress bar."""
    from tqdm import tqdm

    from improvo.files import check_output_folder
    from improvo.simulation.generate import simulate, simulate_many

    settings = _settings(arguments)
    check_output_folder(arguments.output, "simulate")
    common: dict[str, Any] = {"jpeg_quality": arguments.jpeg, "depth_every": arguments.depth_every}
    if arguments.scenes == 1:
        with tqdm(total=settings.frames, unit="frame", desc="simulate") as bar:
            simulate(settings, arguments.output, **common, progress=bar.update)
        print(
            f"{arguments.output}: {settings.frames} frames of {settings.width}x{settings.height}, seed {settings.seed}"
        )
        return
    with tqdm(total=arguments.scenes, unit="scene", desc="simulate") as bar:
        folders = simulate_many(
            settings, arguments.output, arguments.scenes, arguments.workers, **common, progress=bar.update
        )
    print(f"{arguments.output}: {len(folders)} recordings, {folders[0].name} to {folders[-1].name}")


def _settings(arguments: argparse.Namespace) -> SimulationSettings:
    """Preset, or the file, then --set, then the flags."""
    from improvo import config
    from improvo.errors import ConfigError

    for name in ("scenes", "workers", "depth_every"):
        if getattr(arguments, name) < 1:
            raise ConfigError(f"--{name.replace('_', '-')}: must be at least 1")
    if arguments.jpeg is not None and not 1 <= arguments.jpeg <= 100:
        raise ConfigError(f"--jpeg {arguments.jpeg}: must be from 1 to 100")
    base = [] if arguments.config else [f"{k}={v}" for k, v in config.to_dict(preset(arguments.preset)).items()]
    settings = config.load(SimulationSettings, arguments.config, [*base, *arguments.set])
    changes: dict[str, Any] = {name: getattr(arguments, name) for name in _FLAGS if hasattr(arguments, name)}
    if hasattr(arguments, "size"):
        width, _, height = arguments.size.partition("x")
        if not (width.isdigit() and height.isdigit()):
            raise ConfigError(f"--size {arguments.size}: write it as WIDTHxHEIGHT, such as 640x480")
        changes |= {"width": int(width), "height": int(height)}
    if arguments.grey:
        changes["colour"] = False
    return replace(settings, **changes)
