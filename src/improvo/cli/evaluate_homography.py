"""Repeatability, localisation error, mean average precision, matching score and homography accuracy of frontends.

FOLDER is in the HPatches layout (SCENE/1.ppm ... with SCENE/H_1_2 ...), or, with --synthesize, any folder of pictures,
of which random homographies are made.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from improvo.cli.evaluate_options import add_frontend_arguments, add_run_arguments
from improvo.cli.options import add_config_arguments, settings_from
from improvo.cli.output import figures, next_after_figures
from improvo.errors import InputError
from improvo.evaluation.settings import HomographyCommandSettings, HomographySettings

COMMAND = "evaluate homography"
_FLAGS = {
    "max_keypoints": "homography.max_keypoints",
    "longest_side": "homography.longest_side",
    "views": "homography.views",
    "seed": "homography.seed",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `improvo evaluate homography`."""
    defaults, absent = HomographySettings(), argparse.SUPPRESS
    parser.add_argument("folder", nargs="?", type=Path, metavar="FOLDER", help="in the HPatches layout")
    parser.add_argument("--synthesize", type=Path, metavar="IMAGES", help="random homographies of these pictures")
    parser.add_argument(
        "--views",
        type=int,
        default=absent,
        metavar="N",
        help=f"of each picture, synthesized (default: {defaults.views})",
    )
    parser.add_argument(
        "--longest-side",
        type=int,
        default=absent,
        metavar="PIXELS",
        help=f"larger images are made smaller (default: {defaults.longest_side})",
    )
    add_frontend_arguments(parser, defaults.max_keypoints)
    add_run_arguments(parser)
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> int | None:
    """Print the table; with -o leave homography.json and homography.md."""
    from improvo import __version__
    from improvo.cli.evaluate_options import loaded_frontends
    from improvo.evaluation.homography.pairs import hpatches_scenes, picture_scenes
    from improvo.evaluation.homography.protocol import homography_table, run_homography_protocol
    from improvo.files import check_output_folder, make_output_folder, write_json, write_text
    from improvo.jobs.pool import Workers

    settings = settings_from(HomographyCommandSettings, arguments, _FLAGS).homography
    if (arguments.folder is None) == (arguments.synthesize is None):
        raise InputError(
            "improvo evaluate homography: give either a FOLDER in the HPatches layout or --synthesize IMAGES"
        )
    if arguments.synthesize is not None:
        scenes = picture_scenes(arguments.synthesize)
    else:
        scenes = hpatches_scenes(arguments.folder)
    if arguments.output is not None:
        check_output_folder(arguments.output, COMMAND)
    frontends, skipped = loaded_frontends(arguments.frontend, settings.max_keypoints)
    with Workers(arguments.workers, progress=True) as workers:
        found = run_homography_protocol(scenes, frontends, settings, workers)
    results = {"protocol": "homography", "improvo": __version__, **found, "skipped_frontends": skipped}
    text = homography_table(results)
    figures(results, text)
    if arguments.output is not None:
        make_output_folder(arguments.output, COMMAND)
        write_json(arguments.output / "homography.json", results)
        write_text(arguments.output / "homography.md", text)
    next_after_figures(arguments.output)
    return 0
