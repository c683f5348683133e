"""Options that many commands share: how sequences are read, --config and --set."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml

from improvo import config

T = TypeVar("T")

_SEQUENCE_OPTIONS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("format", {"help": "of the sequence (default: guessed)"}),
    ("camera", {"metavar": "FILE", "help": "a calibration file, or fx,fy,cx,cy[,k1,k2,p1,p2,k3]"}),
    ("fov", {"type": float, "metavar": "DEGREES", "help": "horizontal field of view, where nothing better is known"}),
    ("fps", {"type": float, "help": "frame rate of recordings without time stamps"}),
    ("start", {"type": int, "metavar": "N", "help": "first frame (default: 0)"}),
    ("end", {"type": int, "metavar": "N", "help": "one past the last frame (default: all)"}),
    ("stride", {"type": int, "metavar": "N", "help": "every n-th frame (default: 1)"}),
    ("max-frames", {"type": int, "metavar": "N", "help": "at most so many, after the stride (default: all)"}),
    (
        "undistorted-fov",
        {
            "type": float,
            "metavar": "DEGREES",
            "help": "how much of a distorted wide lens is seen (default: all up to 120, beyond that what keeps the "
            "resolution in the middle)",
        },
    ),
    ("width", {"type": int, "metavar": "PIXELS", "help": "resize to this width (default: as recorded)"}),
    ("topic", {"metavar": "NAME", "help": "image topic of a ROS bag, or camera of a recording with several"}),
)

FRONTEND_FLAGS = {"frontend": "frontend.name", "max_keypoints": "frontend.max_keypoints", "seed": "odometry.seed"}


def add_sequence_arguments(parser: argparse.ArgumentParser) -> None:
    """How the sequence is read; read back by `settings_from`."""
    group = parser.add_argument_group("how the sequence is read")
    for name, options in _SEQUENCE_OPTIONS:
        group.add_argument(f"--{name}", default=argparse.SUPPRESS, **options)


def add_frontend_arguments(parser: argparse.ArgumentParser, name: str, max_keypoints: int) -> None:
    """Which frontend, how many keypoints, and the seed; the defaults are only shown. Read back with FRONTEND_FLAGS."""
    parser.add_argument(
        "--frontend",
        default=argparse.SUPPRESS,
        metavar="NAME",
        help=f"sift, orb, akaze, surf, a bundled network or a .safetensors file (default: {name})",
    )
    parser.add_argument(
        "--max-keypoints",
        type=int,
        default=argparse.SUPPRESS,
        metavar="N",
        help=f"per frame (default: {max_keypoints})",
    )
    parser.add_argument("--seed", type=int, default=argparse.SUPPRESS, help="of all random choices (default: 0)")


def add_config_arguments(parser: argparse.ArgumentParser) -> None:
    """`--config FILE` and `--set section.name=value`."""
    group = parser.add_argument_group("every other setting (`improvo config` prints them)")
    group.add_argument("--config", type=Path, metavar="FILE", help="settings as YAML")
    group.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="one setting, such as odometry.loss.min_inliers=20",
    )


def settings_from(
    cls: type[T], arguments: argparse.Namespace, flags: Mapping[str, str], extra: list[str] | None = None
) -> T:
    """Settings from --config, then --set, then the command's own flags.

    Args:
        flags: the name of an argument and the setting that it stands for; absent arguments change nothing.
        extra: further `name=value` settings, applied last.

    Raises:
        ConfigError: an unknown setting or a value of the wrong type.
    """
    names = {name.replace("-", "_"): f"sequence.{name.replace('-', '_')}" for name, _ in _SEQUENCE_OPTIONS} | dict(
        flags
    )
    given = [
        f"{setting}={yaml.safe_dump(getattr(arguments, name), default_flow_style=True).splitlines()[0]}"
        for name, setting in names.items()
        if hasattr(arguments, name)
    ]
    return config.load(cls, arguments.config, [*arguments.set, *given, *(extra or [])])
