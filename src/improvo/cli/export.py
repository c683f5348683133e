"""`improvo export colmap`, `nerfstudio`, `trajectory`, `onnx`: finished runs and networks for other tools."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from improvo.cli.flags import add_setting
from improvo.cli.output import figures, next_step, say, typed
from improvo.cli.show_options import add_recording, add_run_folder, target_path
from improvo.errors import ConfigError, OutputError
from improvo.files import check_output_file, is_same_file

if TYPE_CHECKING:
    from improvo.export.model import Model
    from improvo.odometry.run.run_folder import RunFolder
    from improvo.types import UInt8

_ONNX_SETTINGS = ("max_keypoints", "threshold", "nms_radius", "border", "subpixel_radius")
_FILE_NAMES = {"tum": "trajectory.txt", "kitti": "poses.txt", "euroc": "data.csv"}


def add_colmap_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo export colmap`."""
    _add_model_arguments(parser, "sparse/0, sparse/1, ... (one per segment) and images")
    parser.add_argument("--no-images", action="store_true", help="write only the model, not the frames")


def run_colmap(arguments: argparse.Namespace) -> None:
    """Write the model of every segment, the longest first."""
    from improvo.export.colmap import write_colmap
    from improvo.export.model import segment_model, segments_by_length
    from improvo.folder_lock import working_in
    from improvo.odometry.run.run_folder import RunFolder

    _check_model_arguments(arguments)
    run_folder = RunFolder(arguments.folder, arguments.sequence)
    segments = segments_by_length(run_folder)
    models = [segment_model(run_folder, each, arguments.max_error, arguments.min_observations) for each in segments]
    with working_in(arguments.output, "export colmap"):
        _clear_models(arguments.output / "sparse")
        written = []
        for number, model in enumerate(models):
            colours = None if arguments.no_images else _write_images(run_folder, model, arguments.output / "images")
            target = arguments.output / "sparse" / str(number)
            write_colmap(model, run_folder.camera, target, colours)
            say(
                f"{target}: {len(model.frames)} images, {_points(model)}, {len(model.error)} observations, "
                f"mean re-projection error {model.mean_error:.6f} px"
            )
            written.append(
                {
                    "folder": str(target),
                    "images": len(model.frames),
                    "points": len(model.xyz),
                    "observations": len(model.error),
                    "mean_error": round(model.mean_error, 6),
                }
            )
    figures({"models": written, "map_points": len(run_folder.map)}, "")
    say(f"  the map of the run joins tracks of the same place to {len(run_folder.map)} points")
    next_step(f"open {arguments.output / 'sparse' / '0'} with COLMAP, pycolmap or what reads their model")


def add_nerfstudio_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo export nerfstudio`."""
    _add_model_arguments(parser, "transforms.json, images and a point cloud")


def run_nerfstudio(arguments: argparse.Namespace) -> None:
    """Write the longest segment; one scene has one world."""
    from improvo.export.model import segment_model, segments_by_length
    from improvo.export.nerfstudio import write_nerfstudio
    from improvo.folder_lock import working_in
    from improvo.odometry.run.run_folder import RunFolder

    _check_model_arguments(arguments)
    run_folder = RunFolder(arguments.folder, arguments.sequence)
    segments = segments_by_length(run_folder)
    model = segment_model(run_folder, segments[0], arguments.max_error, arguments.min_observations)
    with working_in(arguments.output, "export nerfstudio"):
        colours = _write_images(run_folder, model, arguments.output / "images")
        write_nerfstudio(model, run_folder.camera, arguments.output, colours)
    say(f"{arguments.output / 'transforms.json'}: {len(model.frames)} images, {_points(model)}")
    if len(segments) > 1:
        left = run_folder.frames - len(model.frames)
        say(f"  only the longest of {len(segments)} segments: {left} frames have no pose in its world")
    next_step(f"`ns-train splatfacto --data {typed(arguments.output)}`, with Nerfstudio installed")


def add_trajectory_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo export trajectory`."""
    add_run_folder(parser)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="file to write")
    parser.add_argument("--format", choices=tuple(_FILE_NAMES), default="tum", help="of the file")


def run_trajectory(arguments: argparse.Namespace) -> None:
    """Write the poses that there are."""
    from improvo.export.trajectory import export_trajectory
    from improvo.odometry.run.run_folder import RunFolder

    run_folder = RunFolder(arguments.folder)
    target = target_path(arguments.output, arguments.output, _FILE_NAMES[arguments.format], (".txt", ".csv"))
    if is_same_file(target, arguments.folder / "trajectory.txt"):
        raise OutputError(f"{target}: is the run's own, in the format tum already; choose another name")
    trajectory = run_folder.trajectory
    export_trajectory(trajectory, run_folder.frames, target, arguments.format, run_folder.unit)
    segments = len(set(trajectory.segment.tolist()))
    if segments > 1 and arguments.format != "tum":
        say(f"note: {segments} segments, each in a world of its own, stand in it without a mark; tum has marks")
    say(f"{target}: {len(run_folder.trajectory)} poses, camera-to-world, {run_folder.unit}")
    next_step(f"`improvo evaluate trajectory {typed(target)} TRUTH` measures them")


def add_onnx_arguments(parser: argparse.ArgumentParser) -> None:
    """Weights, output, and the settings of decoding, which are fixed in the file."""
    from improvo.frontend.settings import NetworkSettings

    defaults = NetworkSettings()
    parser.add_argument("weights", metavar="WEIGHTS", help="a bundled name or a weights file")
    parser.add_argument("-o", "--output", type=Path, required=True, help="ONNX file to write")
    parser.add_argument(
        "--layout", choices=("improvo", "opencv"), default="improvo", help="opencv: a file that `cv2.ALIKED` loads"
    )
    for name in _ONNX_SETTINGS:
        add_setting(parser, defaults, f"--{name.replace('_', '-')}", name)


def run_onnx(arguments: argparse.Namespace) -> None:
    """A network with its decoding as one ONNX file: image in, keypoints, descriptors and stability out."""
    from improvo.export.onnx import export_onnx
    from improvo.frontend.settings import NetworkSettings
    from improvo.frontend.weights_files import find_weights, load_weights

    given = {name: getattr(arguments, name) for name in _ONNX_SETTINGS if hasattr(arguments, name)}
    # the move to corners works on the image beside the network, and is no part of the file
    settings = NetworkSettings(**given, corner_radius=0)
    check_output_file(arguments.output, (".onnx",))
    if not arguments.output.parent.is_dir():
        raise OutputError(f"{arguments.output}: no folder {arguments.output.parent}; make it first")
    export_onnx(load_weights(find_weights(arguments.weights)), arguments.output, settings, arguments.layout)
    for_opencv = arguments.layout == "opencv"
    image = "(1, 3, height, width) RGB" if for_opencv else "(batch, 1, height, width)"
    say(f"{arguments.output}: image {image} in [0, 1] -> {settings.max_keypoints} keypoints")
    say("without the move to the image's corners (`improvo.frontend.corners`), which `improvo run` makes afterwards")
    reader = f"cv2.ALIKED.create('{arguments.output}', parameters)" if for_opencv else ""
    next_step(f"`{reader}` in OpenCV 5" if reader else "load it with ONNX Runtime or any other runtime")


def _points(model: Model) -> str:
    """How many points there are, and of what."""
    return f"{len(model.xyz)} points (one for each good track)"


def _add_model_arguments(parser: argparse.ArgumentParser, contents: str) -> None:
    """What the exports of maps have in common."""
    add_run_folder(parser)
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER", help=f"new folder for {contents}")
    parser.add_argument("--max-error", type=float, default=4.0, metavar="PIXELS", help="drop observations beyond this")
    parser.add_argument("--min-observations", type=int, default=3, metavar="N", help="drop points with fewer")
    add_recording(parser)


def _clear_models(folder: Path) -> None:
    """Remove the models of an earlier export, which may have had more segments."""
    import shutil

    for model in folder.glob("*"):
        if model.name.isdecimal() and not model.is_symlink():
            shutil.rmtree(model, ignore_errors=True)


def _check_model_arguments(arguments: argparse.Namespace) -> None:
    """Refuse what would leave nothing, or points that nothing was seen of.

    Raises:
        ConfigError: see above.
    """
    if not arguments.max_error > 0:
        raise ConfigError(f"--max-error {arguments.max_error:g}: must be positive")
    if arguments.min_observations < 1:
        raise ConfigError(f"--min-observations {arguments.min_observations}: must be at least 1")


def _write_images(run_folder: RunFolder, model: Model, folder: Path) -> UInt8:
    from improvo.export.model import write_images
    from improvo.terminal import progress

    with progress("images", "frame", len(model.frames)) as shown:
        return write_images(run_folder, model, folder, shown.advance)
