"""`improvo weights import / calibrate / show`: weights files in, prepared, and read."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

from improvo.errors import InputError, OutputError
from improvo.types import UInt8


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The sub-verbs and their options."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)

    def action(name: str, help_line: str) -> argparse.ArgumentParser:
        return actions.add_parser(
            name, help=help_line, description=help_line, formatter_class=argparse.ArgumentDefaultsHelpFormatter
        )

    importing = action("import", "convert a public SuperPoint weights file (three layouts, .pth or .safetensors)")
    importing.add_argument("file", type=Path, metavar="FILE")
    importing.add_argument("-o", "--output", type=Path, default=Path("weights.safetensors"), help="file to write")
    importing.add_argument("--licence", default="", help="of the file, for the model card")
    importing.set_defaults(action_function=_import)

    calibrating = action("calibrate", "measure activation ranges on pictures, so that weights can run in int8")
    calibrating.add_argument("weights", metavar="WEIGHTS", help="a bundled name or a weights file")
    calibrating.add_argument("images", type=Path, nargs="+", metavar="IMAGES", help="folders or files of pictures")
    calibrating.add_argument("-o", "--output", type=Path, required=True, help="file to write")
    calibrating.add_argument("--count", type=int, default=64, help="pictures to use, spread evenly")
    calibrating.add_argument("--quantile", type=float, default=0.9999, help="of each picture's activations to keep")
    calibrating.set_defaults(action_function=_calibrate)

    showing = action("show", "print the model card of a weights file")
    showing.add_argument("weights", metavar="WEIGHTS", help="a bundled name or a weights file")
    showing.set_defaults(action_function=_show)


def run(arguments: argparse.Namespace) -> None:
    """Run the chosen sub-verb."""
    arguments.action_function(arguments)


def _import(arguments: argparse.Namespace) -> None:
    from improvo.frontend.importing import convert, read_public_file
    from improvo.frontend.weights import save_weights

    output = _checked_output(arguments.output)
    licence = arguments.licence or "unknown: ask whoever released the original file"
    weights, layout = convert(read_public_file(arguments.file), str(arguments.file), licence)
    save_weights(output, weights.tensors, weights.card)
    print(f"{arguments.file}: {layout.name} -> {output}")
    if not arguments.licence:
        print(
            "licence: converting does not change whose weights these are. The original SuperPoint release is for "
            "non-commercial research only; read your file's own terms before you use or pass on the result, and "
            "record them with --licence."
        )


def _calibrate(arguments: argparse.Namespace) -> None:
    import cv2
    from tqdm import tqdm

    from improvo.frontend.quantisation import calibrate
    from improvo.frontend.weights import find_weights, load_weights, save_weights

    output = _checked_output(arguments.output)
    if arguments.count < 1 or not 0 < arguments.quantile <= 1:
        raise InputError("calibrate: --count must be at least 1, and --quantile in (0, 1]")
    weights = load_weights(find_weights(arguments.weights))
    paths = [path for place in arguments.images for path in _pictures(place)]
    paths = paths[:: max(1, -(-len(paths) // arguments.count))]
    unreadable: list[Path] = []

    def readable() -> Iterator[UInt8]:
        for path in tqdm(paths, desc="calibrate", unit="image"):
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            if image is None:
                unreadable.append(path)
            else:
                yield image

    calibrated = calibrate(weights, readable(), arguments.quantile)
    save_weights(output, calibrated.tensors, calibrated.card)
    if unreadable:
        names = ", ".join(str(path) for path in unreadable[:5])
        print(f"skipped {len(unreadable)} pictures that cannot be read: {names}")
    print(f"{output}: activation ranges over {len(paths) - len(unreadable)} pictures")


def _show(arguments: argparse.Namespace) -> None:
    from improvo import config
    from improvo.frontend.weights import find_weights, load_weights

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
    if path.exists() or path.with_suffix(".json").exists():
        raise OutputError(f"{path}: it or its .json exists already; choose another file with -o")
    if not path.parent.is_dir():
        raise OutputError(f"{path}: no folder {path.parent}; make it first")
    return path
