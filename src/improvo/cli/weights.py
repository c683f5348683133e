"""`improvo weights import / export / calibrate / show`: weights files in, out, prepared, and read."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

from improvo.cli.output import next_step, say, typed
from improvo.errors import InputError, OutputError
from improvo.files import check_output_file
from improvo.types import UInt8

_CONSUMERS = {
    "original": "load {output} where a program wants `superpoint_v1.pth`",
    "rpautrat": "`SuperPoint().load_state_dict(torch.load('{output}'))` with that program's class",
    "transformers": "`SuperPointForKeypointDetection.from_pretrained('{output}')`",
}


def add_import_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo weights import`."""
    parser.add_argument("file", type=Path, metavar="FILE")
    parser.add_argument("-o", "--output", type=Path, default=Path("weights.safetensors"), help="file to write")
    parser.add_argument("--licence", default="", help="of the file, for the model card")


def add_export_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo weights export`."""
    from improvo.export.weights_layouts import NAMES

    _add_weights(parser)
    parser.add_argument("--layout", choices=NAMES, required=True, help="original: LightGlue, hloc, SuperGlue, pySLAM")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="FILE",
        help=".pth (needs the extra `train`) or .safetensors; a new folder for transformers",
    )


def add_calibrate_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo weights calibrate`."""
    _add_weights(parser)
    parser.add_argument("images", type=Path, nargs="+", metavar="IMAGES", help="folders or files of pictures")
    parser.add_argument("-o", "--output", type=Path, required=True, help="file to write")
    parser.add_argument("--count", type=int, default=64, help="pictures to use, spread evenly")
    parser.add_argument("--quantile", type=float, default=0.9999, help="of each picture's activations to keep")


def add_show_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo weights show`."""
    _add_weights(parser)


def _add_weights(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("weights", metavar="WEIGHTS", help="a bundled name or a weights file")


def run_import(arguments: argparse.Namespace) -> None:
    """Convert a public file."""
    from improvo.frontend.importing import convert, read_public_file
    from improvo.frontend.weights_files import save_weights

    output = _checked_output(arguments.output)
    licence = arguments.licence or "unknown: ask whoever released the original file"
    weights, layout = convert(read_public_file(arguments.file), str(arguments.file), licence)
    save_weights(output, weights.tensors, weights.card)
    say(f"{arguments.file}: {layout.name} -> {output}")
    if not arguments.licence:
        say(
            "licence: converting does not change whose weights these are. The original SuperPoint release is for "
            "non-commercial research only; read your file's own terms before you use or pass on the result, and "
            "record them with --licence."
        )
    next_step(f"`improvo run SEQUENCE --frontend {typed(output)} -o out` uses them")


def run_export(arguments: argparse.Namespace) -> None:
    """Weights in the layout of a public SuperPoint implementation, which loads them and computes the same.

    The move of keypoints to the image's corners is no part of a network, so others leave it out.
    """
    from improvo.export.weights_layouts import export_weights, left_out
    from improvo.files import check_output_folder
    from improvo.frontend.weights_files import find_weights, load_weights

    output: Path = arguments.output
    if arguments.layout == "transformers":
        check_output_folder(output, "weights export")
    else:
        _check_new(output)
    weights = load_weights(find_weights(arguments.weights))
    export_weights(weights, arguments.layout, output)
    width = weights.architecture.descriptor
    dimensions = width if arguments.layout == "transformers" else 256
    padded = f", the last {dimensions - width} of them 0" if width < dimensions else ""
    say(f"{arguments.weights} -> {output}: layout {arguments.layout}, descriptors of {dimensions} numbers{padded}")
    for part in left_out(weights):
        say(f"left out, since the layout has no place for it: {part}")
    say(
        "a matcher that was trained on other descriptors (SuperGlue, LightGlue) does not fit these; match by nearest "
        "neighbours"
    )
    next_step(_CONSUMERS[arguments.layout].format(output=output))


def run_calibrate(arguments: argparse.Namespace) -> None:
    """Measure activation ranges and write them beside the weights."""
    from improvo.frontend.quantisation import calibrate
    from improvo.frontend.weights_files import find_weights, load_weights, save_weights
    from improvo.sequences.base import UnreadableFrameError
    from improvo.sequences.images import read_grey
    from improvo.terminal import progress

    output = _checked_output(arguments.output)
    if arguments.count < 1 or not 0 < arguments.quantile <= 1:
        raise InputError("calibrate: --count must be at least 1, and --quantile in (0, 1]")
    weights = load_weights(find_weights(arguments.weights))
    paths = [path for place in arguments.images for path in _pictures(place)]
    count = min(arguments.count, len(paths))
    paths = [paths[number * len(paths) // count] for number in range(count)]
    unreadable: list[Path] = []

    def readable() -> Iterator[UInt8]:
        for path in paths:
            shown.advance()
            try:
                image = read_grey(path)
            except UnreadableFrameError:
                unreadable.append(path)
            else:
                yield image

    with progress("calibrate", "image", len(paths)) as shown:
        calibrated = calibrate(weights, readable(), arguments.quantile)
    save_weights(output, calibrated.tensors, calibrated.card)
    if unreadable:
        names = ", ".join(str(path) for path in unreadable[:5])
        say(f"skipped {len(unreadable)} pictures that cannot be read: {names}")
    say(f"{output}: activation ranges over {len(paths) - len(unreadable)} pictures")
    next_step(f"`improvo run SEQUENCE --frontend {typed(output)} -o out` runs them in int8")


def run_show(arguments: argparse.Namespace) -> None:
    """Print the model card."""
    from improvo import config
    from improvo.frontend.weights_files import find_weights, load_weights

    card = load_weights(find_weights(arguments.weights)).card
    print(json.dumps(config.to_dict(card), indent=2))


def _pictures(place: Path) -> list[Path]:
    if place.is_file():
        return [place]
    kinds = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp"}
    found = sorted(path for path in place.rglob("*") if path.suffix.lower() in kinds) if place.is_dir() else []
    if not found:
        raise InputError(f"{place}: no pictures there; give a folder of PNG or JPEG files")
    return found


def _checked_output(path: Path) -> Path:
    if path.suffix != ".safetensors":
        raise OutputError(f"{path}: weights are written as .safetensors; name the output so")
    _check_new(path)
    return path


def _check_new(path: Path) -> None:
    check_output_file(path)
    if path.exists() or path.with_suffix(".json").exists():
        raise OutputError(f"{path}: it or its .json exists already; choose another file with -o")
    if not path.parent.is_dir():
        raise OutputError(f"{path}: no folder {path.parent}; make it first")
