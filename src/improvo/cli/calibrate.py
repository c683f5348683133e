"""A camera from a recording of a board (`--board 9x6:25mm`), and the board to print (`--print-board board.pdf`)."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from improvo.cli.output import next_step, say
from improvo.errors import ConfigError, InputError

if TYPE_CHECKING:
    from improvo.calibration.camera_fit import CameraFit


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo calibrate`."""
    parser.add_argument(
        "recording", nargs="?", type=Path, metavar="RECORDING", help="a video or image folder that shows the board"
    )
    parser.add_argument(
        "--board",
        default="9x6:25mm",
        metavar="SPEC",
        help="checkerboard by inner corners, 9x6:25mm, or ChArUco by squares, charuco:8x11:20mm",
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("camera.yaml"), metavar="FILE", help="the calibration"
    )
    parser.add_argument(
        "--model",
        default="auto",
        choices=("auto", "brown4", "brown5", "brown8", "fisheye"),
        help="distortion; auto takes the simplest that explains the corners",
    )
    parser.add_argument("--samples", type=int, default=120, metavar="N", help="frames to search for the board")
    parser.add_argument("--views", type=int, default=40, metavar="N", help="boards to use at most")
    parser.add_argument("--format", default="auto", help="of the recording")
    parser.add_argument("--topic", metavar="NAME", help="image topic of a ROS bag")
    parser.add_argument("--print-board", type=Path, metavar="PDF", help="write the board at true size, and stop")
    parser.add_argument("--paper", default="A4", choices=("A4", "A3", "A2", "letter"), help="for --print-board")


def run(arguments: argparse.Namespace) -> None:
    """Print the board, or calibrate and write `camera.yaml` and the coverage picture beside it."""
    from improvo.calibration.board import parse_board, print_board

    board = parse_board(arguments.board)
    if arguments.print_board is not None:
        print_board(board, arguments.print_board, arguments.paper)
        say(f"{arguments.print_board}: print it at 100 %, check the ruler, glue it to something flat")
        return
    if arguments.recording is None:
        raise ConfigError("give a recording of the board, or --print-board FILE.pdf to make one")
    if min(arguments.samples, arguments.views) < 1:
        raise ConfigError("--samples and --views must be at least 1")
    from improvo.calibration.from_board import calibrate, write_camera, write_coverage
    from improvo.sequences.base import SequenceSettings, sampled_pictures
    from improvo.sequences.opening import open_recording
    from improvo.terminal import progress

    settings = SequenceSettings(format=arguments.format, topic=arguments.topic)
    recording = open_recording(arguments.recording, settings)
    found = 0
    with progress("calibrate", "frame", min(arguments.samples, len(recording))) as shown:

        def told(seen: bool) -> None:
            nonlocal found
            found += seen
            shown.note(f"the board in {found}")
            shown.advance()

        pictures = sampled_pictures(recording, arguments.samples)
        try:
            fit = calibrate(pictures, board, arguments.model, arguments.views, told)
        except InputError as error:
            raise InputError(f"{recording.path}: {error}") from None
    picture = arguments.output.with_name(f"{arguments.output.stem}-coverage.png")
    write_camera(arguments.output, fit)
    write_coverage(picture, fit)
    _print(fit, arguments.recording)
    say(f"written: {arguments.output}, {picture}")
    next_step(f"`improvo run VIDEO --camera {arguments.output} -o out`")


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
