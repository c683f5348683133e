"""`improvo export colmap OUT -o FOLDER`: a finished run as COLMAP's sparse model."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The run, the output, and which points are good enough."""
    add_model_arguments(parser, "sparse/0, sparse/1, ... (one per segment) and images")
    parser.add_argument("--no-images", action="store_true", help="write only the model, not the frames")


def add_model_arguments(parser: argparse.ArgumentParser, contents: str) -> None:
    """What the exports of maps have in common."""
    parser.add_argument("folder", type=Path, metavar="OUT", help="output folder of `improvo run`")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER", help=f"new folder for {contents}")
    parser.add_argument("--max-error", type=float, default=4.0, metavar="PIXELS", help="drop observations beyond this")
    parser.add_argument("--min-observations", type=int, default=3, metavar="N", help="drop points with fewer")
    parser.add_argument(
        "--sequence", type=Path, metavar="PATH", help="where the recording is now (default: where it was)"
    )


def run(arguments: argparse.Namespace) -> None:
    """Write the model of every segment, the longest first."""
    from improvo.export.colmap import write_colmap
    from improvo.export.model import segment_model, segments_by_length, write_images
    from improvo.files import make_output_folder
    from improvo.odometry.run_folder import RunFolder

    run_folder = RunFolder(arguments.folder, arguments.sequence)
    segments = segments_by_length(run_folder)
    make_output_folder(arguments.output, "export colmap")
    for number, segment in enumerate(segments):
        model = segment_model(run_folder, segment, arguments.max_error, arguments.min_observations)
        colours = None if arguments.no_images else write_images(run_folder, model, arguments.output / "images")
        target = arguments.output / "sparse" / str(number)
        write_colmap(model, run_folder.camera, target, colours)
        print(
            f"{target}: {len(model.frames)} images, {len(model.xyz)} points, {len(model.error)} observations, "
            f"mean re-projection error {model.mean_error:.6f} px"
        )
