"""Options that many commands share: how sequences are read, the frontend, --config, --set and --preset."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from improvo import config
from improvo.cli.flags import add_setting
from improvo.cli.output import typed
from improvo.errors import ConfigError, InputError
from improvo.files import MARKER
from improvo.presets import preset, presets
from improvo.sequences.base import SequenceSettings

T = TypeVar("T")

_SEQUENCE_OPTIONS: dict[str, dict[str, Any]] = {
    "format": {"help": "of the sequence (default: guessed)"},
    "camera": {"metavar": "FILE"},
    "fov": {"metavar": "DEGREES"},
    "fps": {},
    "start": {},
    "end": {"help": "one past the last frame of the recording (default: all)"},
    "stride": {},
    "max_frames": {"help": "at most so many, after the stride (default: all)"},
    "undistorted_fov": {
        "metavar": "DEGREES",
        "help": "how much of a distorted wide lens is seen (default: all up to 120, beyond that what keeps the "
        "resolution in the middle)",
    },
    "width": {"metavar": "PIXELS", "help": "resize to this width (default: as recorded)"},
    "topic": {"metavar": "NAME"},
    "mask": {"metavar": "FILE"},
}


def add_sequence_arguments(
    parser: argparse.ArgumentParser, defaults: SequenceSettings | None = None, without: tuple[str, ...] = ()
) -> None:
    """How the sequence is read, all but the options `without`; read back by `settings_from`."""
    group = parser.add_argument_group("how the sequence is read")
    defaults = defaults or SequenceSettings()
    for name, options in _SEQUENCE_OPTIONS.items():
        if name in without:
            continue
        add_setting(group, defaults, f"--{name.replace('_', '-')}", name, section="sequence.", **options)


def add_frontend_arguments(parser: argparse.ArgumentParser, defaults: Any, seed: str = "odometry.seed") -> None:
    """Which frontend, how many keypoints, how a network runs, and the seed.

    Args:
        defaults: settings with the section `frontend`.
        seed: the setting that `--seed` stands for.
    """
    add_setting(parser, defaults, "--frontend", "frontend.name", metavar="NAME")
    add_setting(parser, defaults, "--max-keypoints", "frontend.max_keypoints")
    network = "frontend.network"
    add_setting(
        parser, defaults, "--threshold", f"{network}.threshold", help="least probability of a network's keypoint"
    )
    add_setting(parser, defaults, "--device", f"{network}.device", help="of a network; cuda needs the extra `train`")
    add_setting(parser, defaults, "--precision", f"{network}.precision", help="of a network")
    add_setting(parser, defaults, "--seed", seed, help="of all random choices")


def add_config_arguments(parser: argparse.ArgumentParser) -> None:
    """`--config FILE` and `--set section.name=value`."""
    group = parser.add_argument_group("every other setting (`improvo config` prints them)")
    group.add_argument("--config", type=Path, metavar="FILE", help="settings as YAML")
    group.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="one setting, such as odometry.loss.max_lost_frames=20",
    )


def recording_path(text: str) -> Path:
    """The path of a recording; `demo` is the bundled one, unless a recording has that name."""
    path = Path(text)
    # `improvo demo -o demo` leaves a folder of that name, which is none
    if text != "demo" or (path.exists() and not (path / MARKER).is_file()):
        return path
    from improvo.simulation import bundled_sequence

    return bundled_sequence()


def pictures_source(text: str) -> str:
    """A source of pictures, `SOURCE` or `SOURCE=WEIGHT`; `demo` is the bundled recording as in `recording_path`."""
    name, separator, weight = text.partition("=")
    if name != "demo" or (separator and Path(text).exists()):
        return text
    return f"{recording_path(name)}{separator}{weight}"


def recording_words(path: Path) -> str:
    """A recording as the user would type it in a command: the bundled one is `demo`, wherever it lies."""
    from improvo.simulation import bundled_sequence

    return "demo" if path == bundled_sequence() else typed(path)


def folder_path(text: str) -> Path:
    """The type of an argument that names a folder to write in, here or at a location such as `s3://bucket/folder`."""
    from improvo.locations import local_folder

    return local_folder(text)


def read_folder_path(text: str) -> Path:
    """As `folder_path`, of a folder that is only read."""
    from improvo.locations import local_folder

    return local_folder(text, writing=False)


def check_recordings(paths: list[Path], settings: SequenceSettings) -> None:
    """Refuse a list of recordings of which none is there; where only some are missing, the rest is worked on.

    Args:
        paths: of the recordings.
        settings: whose calibration and mask serve all of them, and must be there.

    Raises:
        InputError: none is there, or no calibration, or no mask.
    """
    from improvo.sequences.rates import AUTO

    if settings.camera not in (None, AUTO) and not Path(settings.camera).is_dir():  # a folder has one for each
        from improvo.geometry.camera_files import load_calibration

        load_calibration(settings.camera)
    if settings.mask is not None and not Path(settings.mask).exists():
        mend = "`improvo info SEQUENCE --write-mask FILE` makes one"
        raise InputError(f"--mask {settings.mask}: no such file or folder; {mend}")
    from improvo.sequences.live import is_live

    if not any(path.exists() or is_live(str(path)) for path in paths):
        raise InputError(f"{paths[0]}: no such file or folder; check the path")


def add_preset_argument(parser: argparse.ArgumentParser, class_name: str) -> None:
    """`--preset NAME`, where the command's settings have presets."""
    names = list(presets(class_name))
    if names:
        what = "everything that the paper fixes" if names == ["paper"] else "whole settings by name"
        parser.add_argument(
            "--preset", choices=names, help=f"{what}; --config, --set and flags change it (`improvo config` prints it)"
        )


def settings_from(
    cls: type[T],
    arguments: argparse.Namespace,
    flags: Mapping[str, str] | None = None,
    extra: list[str] | None = None,
) -> T:
    """Settings from --preset, then --config, then --set, then the command's own flags.

    Args:
        flags: further arguments, and the settings that they stand for; absent arguments change nothing.
        extra: further `name=value` settings, applied last.

    Raises:
        ConfigError: an unknown setting or a value of the wrong type.
    """
    if hasattr(arguments, "camera") and hasattr(arguments, "fov"):
        raise ConfigError(
            f"--camera {arguments.camera} and --fov {arguments.fov:g}: both say what the camera is; give one"
        )
    names = {**getattr(arguments, "flags", {}), **(flags or {})}
    given = [
        f"{setting}={config.yaml_line(getattr(arguments, name))}"
        for name, setting in names.items()
        if hasattr(arguments, name)
    ]
    name = getattr(arguments, "preset", None)
    base = preset(cls, name) if name else None
    return config.load(cls, arguments.config, [*arguments.set, *given, *(extra or [])], base)
