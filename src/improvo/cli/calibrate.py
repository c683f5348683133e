"""A camera from the motion of any video, or from a recording of a board (`--board 9x6:25mm`).

Without `--board` the camera is found from the video itself: walk sideways, turn, show things near and far. A video that
does not tell its camera is refused. `--print-board board.pdf` makes a board to print.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from improvo.cli.flags import add_setting
from improvo.cli.options import add_config_arguments, add_sequence_arguments, recording_path, settings_from
from improvo.cli.output import figures, next_step, notice, say, typed
from improvo.errors import ConfigError, InputError
from improvo.files import check_output_file
from improvo.self_calibration.settings import SelfCalibrationSettings

if TYPE_CHECKING:
    from improvo.calibration.camera_fit import CameraFit
    from improvo.self_calibration.from_motion import CameraFromMotion

_BOARD = "9x6:25mm"
_OF_A_BOARD = ("auto", "brown4", "brown5", "brown8", "fisheye")
_OF_MOTION = {"auto": "auto", "brown4": "brown", "fisheye": "fisheye"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo calibrate`."""
    defaults = SelfCalibrationSettings()
    parser.add_argument(
        "recording",
        nargs="?",
        type=recording_path,
        metavar="RECORDING",
        help="a video, an image folder, a data set, or `demo`",
    )
    parser.add_argument(
        "--from",
        dest="source",
        choices=("motion", "board"),
        help="what the camera is found from (default: board where --board is given, else motion)",
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("camera.yaml"), metavar="FILE", help="the calibration"
    )
    parser.add_argument(
        "--model",
        default="auto",
        choices=_OF_A_BOARD,
        help="distortion; auto takes the simplest that explains the pictures; from motion auto, brown4 (its two radial "
        "coefficients) or fisheye",
    )
    group = parser.add_argument_group("from motion")
    add_setting(group, defaults, "--frames", "frames")
    add_setting(group, defaults, "--frontend", "frontend.name", metavar="NAME")
    add_setting(group, defaults, "--seed", "seed")
    group = parser.add_argument_group("from a board")
    group.add_argument(
        "--board",
        metavar="SPEC",
        help=f"checkerboard by inner corners, {_BOARD}, or ChArUco by squares, charuco:8x11:20mm",
    )
    group.add_argument("--samples", type=int, default=120, metavar="N", help="frames to search for the board")
    group.add_argument("--views", type=int, default=40, metavar="N", help="boards to use at most")
    group.add_argument("--print-board", type=Path, metavar="PDF", help="write the board at true size, and stop")
    group.add_argument("--paper", default="A4", choices=("A4", "A3", "A2", "letter"), help="for --print-board")
    add_sequence_arguments(parser, without=("camera", "fov", "undistorted_fov", "width"))
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> None:
    """Print the board, or find the camera and write `camera.yaml`."""
    from improvo.calibration.board import parse_board, print_board

    if arguments.source == "motion" and (arguments.board is not None or arguments.print_board is not None):
        raise ConfigError("--from motion needs no board; leave out --board and --print-board")
    board = parse_board(arguments.board or _BOARD)
    if arguments.print_board is not None:
        check_output_file(arguments.print_board, (".pdf",))
        print_board(board, arguments.print_board, arguments.paper)
        say(f"{arguments.print_board}: print it at 100 %, check the ruler, glue it to something flat")
        return
    if arguments.recording is None:
        raise ConfigError("give a video, or --print-board FILE.pdf to make a board for one")
    settings = settings_from(SelfCalibrationSettings, arguments)
    of_a_board = arguments.source == "board" or (arguments.source is None and arguments.board is not None)
    check_output_file(arguments.output, (".yaml", ".yml"), "" if of_a_board else ".json")
    if of_a_board:
        _from_board(arguments, settings)
    else:
        _from_motion(arguments, settings)
    next_step(f"`improvo run VIDEO --camera {typed(arguments.output)} -o out`")


def _from_motion(arguments: argparse.Namespace, settings: SelfCalibrationSettings) -> None:
    """Find the camera from the video itself; `camera.yaml`, and all figures beside it as JSON."""
    from dataclasses import replace

    from improvo.odometry.run.compile import compile_odometry
    from improvo.self_calibration.from_motion import camera_from_motion
    from improvo.sequences.opening import open_recording
    from improvo.terminal import stages

    if arguments.model not in _OF_MOTION:
        raise ConfigError(f"--model {arguments.model}: needs a board; from motion choose {', '.join(_OF_MOTION)}")
    if arguments.model != "auto":
        settings = replace(settings, model=_OF_MOTION[arguments.model])
    open_recording(arguments.recording, settings.sequence)  # before anything else, and before compiling
    say(f"{arguments.recording}: finding the camera from the motion (with a printed board: --board {_BOARD})")
    compile_odometry(notice)
    with stages("step") as told:
        found = camera_from_motion(arguments.recording, settings, told)
    found.write(arguments.output)
    figures(found.figures, _table(found))
    say(f"written: {arguments.output}, {arguments.output.with_suffix('.json')}")


def _table(found: CameraFromMotion) -> str:
    camera = found.camera
    lines = [
        f"{camera.width}x{camera.height}, model {camera.distortion_model}, {found.fov:.1f} degrees wide; RMS "
        f"{found.rms:.3f} px over {found.observations} observations of {found.points} points in {found.views} views; "
        f"{found.tracked} of {found.frames} frames have a pose"
    ]
    lines += [f"  {name:<3} {value:12.6g}  +- {found.deviations[name]:.2g}" for name, value in found.values.items()]
    lines.append(f"  focal length +- {100 * found.focal_deviation:.2g} %")
    read = f"{1000 * found.readout:.1f} ms +- {1000 * found.readout_deviation:.2g}"
    rolling = abs(found.readout) > 3 * found.readout_deviation + 0.002
    lines.append(f"  read-out of a picture {read}: " + ("a rolling shutter" if rolling else "no rolling shutter seen"))
    return "\n".join(lines)


def _from_board(arguments: argparse.Namespace, settings: SelfCalibrationSettings) -> None:
    """Calibrate with a board; `camera.yaml`, and the coverage picture beside it."""
    from improvo.calibration.board import parse_board
    from improvo.calibration.from_board import calibrate, write_camera, write_coverage
    from improvo.self_calibration.raw_features import open_raw, sampled_pictures
    from improvo.terminal import progress

    if min(arguments.samples, arguments.views) < 1:
        raise ConfigError("--samples and --views must be at least 1")
    sequence = open_raw(arguments.recording, settings.sequence)
    found = 0
    with progress("calibrate", "frame", min(arguments.samples, len(sequence))) as shown:

        def told(seen: bool) -> None:
            nonlocal found
            found += seen
            shown.note(f"the board in {found}")
            shown.advance()

        pictures = sampled_pictures(sequence, arguments.samples)
        try:
            board = parse_board(arguments.board or _BOARD)
            fit = calibrate(pictures, board, arguments.model, arguments.views, told)
        except InputError as error:
            raise InputError(f"{sequence.path}: {error}") from None
    picture = arguments.output.with_name(f"{arguments.output.stem}-coverage.png")
    write_camera(arguments.output, fit)
    write_coverage(picture, fit)
    _print(fit, arguments.recording)
    say(f"written: {arguments.output}, {picture}")


def _print(fit: CameraFit, path: Path) -> None:
    camera = fit.camera
    say(f"{path}: {camera.width}x{camera.height}, {len(fit.views)} views, model {fit.model}, RMS {fit.rms:.3f} px")
    others = ", ".join(f"{name} {rms:.3f}" for name, rms in fit.tried.items() if name != fit.model)
    if others:
        say(f"  others tried (RMS): {others}")
    values = dict(zip(("fx", "fy", "cx", "cy"), (camera.fx, camera.fy, camera.cx, camera.cy), strict=True))
    if camera.distortion_model == "fisheye":
        names: tuple[str, ...] = ("k1", "k2", "k3", "k4")
    else:
        names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    values |= dict(zip(names, camera.distortion, strict=False))
    for name, value in values.items():
        say(f"  {name:<3} {value:12.6g}  +- {fit.deviations.get(name, float('nan')):.2g}")
    say(f"  the board reached {100 * float((fit.coverage > 0).mean()):.0f} % of the picture")
