"""`improvo export nerfstudio OUT -o FOLDER`: a finished run as Nerfstudio's input."""

from __future__ import annotations

import argparse

from improvo.cli.export_colmap import add_model_arguments


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The run, the output, and which points are good enough."""
    add_model_arguments(parser, "transforms.json, images and a point cloud")


def run(arguments: argparse.Namespace) -> None:
    """Write the longest segment; one scene has one world."""
    from improvo.export.model import segment_model, segments_by_length, write_images
    from improvo.export.nerfstudio import write_nerfstudio
    from improvo.files import make_output_folder
    from improvo.odometry.run_folder import RunFolder

    run_folder = RunFolder(arguments.folder, arguments.sequence)
    segments = segments_by_length(run_folder)
    make_output_folder(arguments.output, "export nerfstudio")
    model = segment_model(run_folder, segments[0], arguments.max_error, arguments.min_observations)
    colours = write_images(run_folder, model, arguments.output / "images")
    write_nerfstudio(model, run_folder.camera, arguments.output, colours)
    print(f"{arguments.output / 'transforms.json'}: {len(model.frames)} images, {len(model.xyz)} points")
    if len(segments) > 1:
        left = run_folder.frames - len(model.frames)
        print(f"  only the longest of {len(segments)} segments: {left} frames have no pose in its world")
