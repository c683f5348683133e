"""Options that the protocols of `sivo evaluate` share, and what they mean."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from sivo.errors import ConfigError, MissingExtraError

if TYPE_CHECKING:
    from sivo.evaluation.sources import FeatureSource, Recorded

DEFAULT_FRONTENDS = ["sift", "orb", "akaze"]


def add_feature_arguments(parser: argparse.ArgumentParser) -> None:
    """Which frontends, and how many keypoints."""
    parser.add_argument(
        "--frontend",
        action="append",
        metavar="NAME",
        help="sift, orb, akaze, surf, superpoint-vo, ..., a .safetensors file, a peer (xfeat, aliked, disk), or `all` "
        f"that can run; LABEL=NAME names its row; repeatable (default: {', '.join(DEFAULT_FRONTENDS)})",
    )
    parser.add_argument(
        "--features",
        action="append",
        default=[],
        metavar="[LABEL=]DIR",
        help="features exported by another program: a folder of NPZ files, or an HDF5 file of hloc; repeatable",
    )
    parser.add_argument("--max-keypoints", type=int, default=500, help="kept per image, best first")


def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """Seed, processes, output folder."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    parser.add_argument("--seed", type=int, default=0, help="of all random choices")
    parser.add_argument("--workers", type=int, default=cores, help="processes")
    parser.add_argument("-o", "--output", type=Path, metavar="OUT", help="folder for results and computed features")


def add_sequence_arguments(parser: argparse.ArgumentParser) -> None:
    """How sequences are read."""
    group = parser.add_argument_group("how sequences are read")
    group.add_argument("--format", default="auto", help="of the sequences")
    group.add_argument("--camera", help="a calibration file, or fx,fy,cx,cy[,k1,k2,p1,p2,k3]")
    group.add_argument("--start", type=int, default=0, help="first frame")
    group.add_argument("--end", type=int, help="one past the last frame")
    group.add_argument("--stride", type=int, default=1, help="every n-th frame; gaps count the frames that are left")
    group.add_argument("--width", type=int, help="resize to this width")


def sequence_sources(arguments: argparse.Namespace) -> list[Recorded]:
    """The sequences of the command line, not opened yet."""
    from sivo.evaluation.sources import Recorded
    from sivo.sequences import SequenceSettings

    settings = SequenceSettings(
        format=arguments.format,
        camera=arguments.camera,
        start=arguments.start,
        end=arguments.end,
        stride=arguments.stride,
        width=arguments.width,
    )
    return [Recorded(path, settings) for path in arguments.sequences]


def feature_sources(
    arguments: argparse.Namespace, one_sequence: bool
) -> tuple[list[FeatureSource], list[dict[str, str]]]:
    """The frontends of the command line, each tried once so that a wrong name fails before any work.

    Returns:
        The frontends, and those of `all` that cannot run here, with the reason.

    Raises:
        ConfigError: an unknown name. MissingExtraError: one that was named cannot run here.
    """
    from sivo.evaluation.exported import ExportedFeatures
    from sivo.evaluation.sources import PEERS, LoadedFrontend
    from sivo.frontend.registry import CLASSICAL
    from sivo.frontend.weights import bundled_names

    if arguments.max_keypoints < 4:
        raise ConfigError(f"--max-keypoints {arguments.max_keypoints}: a pose needs at least 4")
    asked = arguments.frontend or ([] if arguments.features else DEFAULT_FRONTENDS)
    names = [name for name in asked if name != "all"]
    optional = [name for name in (*CLASSICAL, *bundled_names(), *PEERS) if name not in names] if "all" in asked else []
    sources: list[FeatureSource] = []
    skipped: list[dict[str, str]] = []
    for name in (*names, *optional):
        label, path = split_label(name)
        source = LoadedFrontend(path, arguments.max_keypoints, label)
        try:
            source.check()
        except MissingExtraError as error:
            if name in names:
                raise
            skipped.append({"frontend": name, "reason": str(error)})
            continue
        sources.append(source)
    for text in arguments.features:
        label, path = split_label(text)
        exported = ExportedFeatures(path, label or Path(path).stem, arguments.max_keypoints, one_sequence)
        exported.check()
        sources.append(exported)
    return sources, skipped


def split_label(text: str) -> tuple[str, str]:
    """`LABEL=REST` in two; the label is empty where there is none."""
    label, separator, rest = text.partition("=")
    return (label, rest) if separator and label else ("", text)
