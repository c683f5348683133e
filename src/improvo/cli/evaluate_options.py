"""Options that the protocols of `improvo evaluate` share, and what they mean."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from improvo.errors import ConfigError, MissingExtraError
from improvo.evaluation.settings import PEERS

if TYPE_CHECKING:
    from improvo.evaluation.sources import FeatureSource, LoadedFrontend, Recorded
    from improvo.sequences.base import SequenceSettings

DEFAULT_FRONTENDS = ("sift", "orb", "akaze")


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def add_frontend_arguments(
    parser: argparse.ArgumentParser,
    max_keypoints: int,
    default: Sequence[str] = DEFAULT_FRONTENDS,
    peers: bool = True,
) -> None:
    """Which frontends, and how many keypoints (the defaults are given for the help only).

    Args:
        parser: of the command.
        max_keypoints: where none are given.
        default: frontends where none is given.
        peers: whether other people's networks can be asked for.
    """
    others = f", a peer ({', '.join(PEERS)})" if peers else ""
    parser.add_argument(
        "--frontend",
        action="append",
        metavar="NAME",
        help=f"sift, orb, akaze, surf, superpoint-vo, ..., a .safetensors file{others}, or `all` that can run; "
        f"LABEL=NAME names its row; repeatable (default: {', '.join(default)})",
    )
    parser.add_argument(
        "--max-keypoints",
        type=int,
        default=argparse.SUPPRESS,
        metavar="N",
        help=f"kept per image, best first (default: {max_keypoints})",
    )


def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """Seed, processes, output folder."""
    parser.add_argument("--seed", type=int, default=argparse.SUPPRESS, help="of all random choices (default: 0)")
    parser.add_argument("--workers", type=int, default=available_cores(), metavar="N", help="processes")
    parser.add_argument("-o", "--output", type=Path, metavar="OUT", help="folder for the results")


def add_truth_argument(parser: argparse.ArgumentParser) -> None:
    """Which true poses replace those of the sequences."""
    parser.add_argument(
        "--truth",
        action="append",
        default=[],
        metavar="FILE",
        help="true poses instead of the sequence's own: a file of `improvo truth`, a TUM trajectory or the folder of a "
        "COLMAP model, whose camera is used too; one for each SEQUENCE, in their order",
    )


def recorded_sequences(arguments: argparse.Namespace, settings: SequenceSettings) -> list[Recorded]:
    """The sequences of the command line, each with its `--truth`.

    Raises:
        ConfigError: another number of `--truth` than of sequences.
    """
    from improvo.evaluation.sources import Recorded

    paths, truths = arguments.sequences, arguments.truth
    if truths and len(truths) != len(paths):
        raise ConfigError(f"--truth: {len(truths)} given for {len(paths)} sequences; give one for each, or none")
    chosen: list[str | None] = truths or [None] * len(paths)
    return [Recorded(str(path), settings, truth) for path, truth in zip(paths, chosen, strict=True)]


def loaded_frontends(
    asked: list[str] | None, max_keypoints: int, default: Sequence[str] = DEFAULT_FRONTENDS, peers: bool = True
) -> tuple[list[LoadedFrontend], list[dict[str, str]]]:
    """The frontends of the command line, each loaded once so that a wrong name fails before any work.

    Args:
        asked: `--frontend` of the command line.
        max_keypoints: per image.
        default: names where none is asked for.
        peers: whether other people's networks are among them.

    Returns:
        The frontends, and those of `all` that cannot run here, with the reason.

    Raises:
        ConfigError, InputError: an unknown name. MissingExtraError: one that was named cannot run here.
    """
    from improvo.evaluation.sources import LoadedFrontend
    from improvo.frontend.registry import CLASSICAL
    from improvo.frontend.weights_files import bundled_names

    asked = asked or list(default)
    named = [name for name in asked if name != "all"]
    known = (*CLASSICAL, *bundled_names(), *(PEERS if peers else ()))
    optional = [name for name in known if name not in named] if "all" in asked else []
    found: list[LoadedFrontend] = []
    skipped: list[dict[str, str]] = []
    for text in (*named, *optional):
        label, name = split_label(text)
        source = LoadedFrontend(name, max_keypoints, label)
        if name in PEERS and not peers:
            raise ConfigError(f"--frontend {name}: odometry has only our own frontends; `evaluate pose` compares peers")
        try:
            source.check()
        except MissingExtraError as error:
            if text in named:
                raise
            skipped.append({"frontend": name, "reason": str(error)})
        else:
            found.append(source)
    return found, skipped


def exported_features(asked: list[str], max_keypoints: int, one_sequence: bool) -> list[FeatureSource]:
    """The `--features` of the command line, each looked into once.

    Args:
        asked: `[LABEL=]PATH` of each.
        max_keypoints: per image.
        one_sequence: whether the run has a single sequence.

    Raises:
        InputError: nothing exported there.
    """
    from improvo.evaluation.frontends.exported import ExportedFeatures

    found: list[FeatureSource] = []
    for text in asked:
        label, path = split_label(text)
        exported = ExportedFeatures(path, label or Path(path).stem, max_keypoints, one_sequence)
        exported.check()
        found.append(exported)
    return found


def split_label(text: str) -> tuple[str, str]:
    """`LABEL=REST` in two; the label is empty where there is none."""
    label, separator, rest = text.partition("=")
    return (label, rest) if separator and label else ("", text)
