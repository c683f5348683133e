"""Features and matches of a recording for hloc or COLMAP, which reconstruct from them.

The layout hloc is features.h5, matches.h5, pairs.txt and intrinsics.txt; the layout colmap is database.db with
verified two-view geometries. Both have the frames, undistorted as the features see them, in `images`.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from improvo.cli.auto_camera import with_found_camera
from improvo.cli.flags import add_setting
from improvo.cli.options import (
    add_config_arguments,
    add_frontend_arguments,
    add_sequence_arguments,
    recording_path,
    settings_from,
)
from improvo.cli.output import figures, next_step, say, typed
from improvo.export.settings import FeatureExportSettings

_FILES = {  # of each layout
    "hloc": ("features.h5", "matches.h5", "pairs.txt", "intrinsics.txt"),
    "colmap": ("database.db",),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo export features`."""
    defaults = FeatureExportSettings()
    parser.add_argument(
        "sequence", type=recording_path, metavar="SEQUENCE", help="a video, an image folder, a data set, or `demo`"
    )
    parser.add_argument("--layout", choices=tuple(_FILES), required=True, help="whose files to write")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER", help="new folder for them")
    add_setting(parser, defaults, "--window", "window")
    add_setting(parser, defaults, "--loop-every", "loop_every")
    add_setting(parser, defaults, "--descriptors", "descriptors", choices=("float16", "float32"))
    parser.add_argument("--no-images", action="store_true", help="leave out the frames")
    add_frontend_arguments(parser, defaults, seed="seed")
    add_sequence_arguments(parser)
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Extract, match and write."""
    settings = settings_from(FeatureExportSettings, arguments)
    from improvo.errors import InputError
    from improvo.evaluation.truth.structure_from_motion import load_pycolmap
    from improvo.export.colmap_database import write_colmap_database
    from improvo.export.features import matched_frames
    from improvo.export.hloc import check_h5py, write_hloc
    from improvo.files import check_output_folder
    from improvo.folder_lock import working_in
    from improvo.frontend.registry import frontend_from
    from improvo.sequences import open_sequence
    from improvo.terminal import counted, progress

    folder: Path = arguments.output
    check_output_folder(folder, "export features")
    for_hloc = arguments.layout == "hloc"
    check_h5py() if for_hloc else load_pycolmap()
    settings = with_found_camera(settings, [arguments.sequence], folder, "export features")
    sequence = open_sequence(arguments.sequence, settings.sequence)
    if sequence.length is None:
        raise InputError(f"{sequence.path}: is live; record it first")
    frontend = frontend_from(settings.frontend)
    images = None if arguments.no_images else folder / "images"
    with working_in(folder, "export features"), progress("features", "frame", sequence.length) as shown:
        frames = matched_frames(sequence, frontend, settings, images, shown.advance)
        if for_hloc:
            written = write_hloc(frames, sequence.camera, folder, settings.descriptors)
        else:
            written = write_colmap_database(frames, sequence.camera, folder, settings.seed)
        for other in set(_FILES) - {arguments.layout}:  # of an earlier export, maybe of another recording
            for name in _FILES[other]:
                (folder / name).unlink(missing_ok=True)
    figures(
        {"folder": str(folder), "layout": arguments.layout, **asdict(written)},
        f"{folder}: {written.images} images, {written.keypoints} keypoints, {written.pairs} "
        f"{'pairs' if for_hloc else 'verified pairs'}, {written.matches} matches",
    )
    if sequence.skipped:
        first = sequence.skipped[0]
        left_out = counted(len(sequence.skipped), "frame")
        say(f"without {left_out} that could not be read, first {first.source}: {first.reason}")
    if for_hloc:
        camera = sequence.camera
        numbers = f"{camera.fx},{camera.fy},{camera.cx + 0.5},{camera.cy + 0.5}"
        next_step(
            f"hloc's `reconstruction.main` with images, pairs.txt, features.h5 and matches.h5 of {folder}, and "
            f"image_options=dict(camera_model='PINHOLE', camera_params='{numbers}')"
        )
    else:
        database, pictures, sparse = (typed(folder / name) for name in ("database.db", "images", "sparse"))
        words = f"--database_path {database} --image_path {pictures} --output_path {sparse}"
        next_step(f"`colmap mapper {words}`, or pycolmap.incremental_mapping with the same three")
    return 0
