"""`improvo export trajectory OUT -o FILE`: poses as TUM, KITTI or EuRoC CSV."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The run, the file and its format."""
    parser.add_argument("folder", type=Path, metavar="OUT", help="output folder of `improvo run`")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="file to write")
    parser.add_argument("--format", choices=("tum", "kitti", "euroc"), default="tum", help="of the file")


def run(arguments: argparse.Namespace) -> None:
    """Write the file."""
    from improvo.cli.show_options import target_path
    from improvo.export.trajectory import export_trajectory
    from improvo.odometry.run_folder import RunFolder

    run_folder = RunFolder(arguments.folder)
    name = {"tum": "trajectory.txt", "kitti": "poses.txt", "euroc": "data.csv"}[arguments.format]
    target = target_path(arguments.output, arguments.output, name)
    export_trajectory(run_folder.trajectory, run_folder.frames, target, arguments.format)
    print(f"{target}: {len(run_folder.trajectory)} poses, camera-to-world, in map units")
