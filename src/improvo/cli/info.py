"""What a recording was recognised as: frames, camera, depth, truth; and what is wrong with it, with advice."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from improvo.cli.auto_camera import with_found_camera
from improvo.cli.flags import add_setting
from improvo.cli.options import (
    add_config_arguments,
    add_sequence_arguments,
    recording_path,
    recording_words,
    settings_from,
)
from improvo.cli.output import figures, next_step, say, typed
from improvo.files import check_output_file
from improvo.sequences.settings import InfoSettings

_CAMERA = ("format", "camera", "fov", "topic")  # options that a run of the same recording needs too


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo info`."""
    parser.add_argument(
        "sequence",
        type=recording_path,
        metavar="SEQUENCE",
        help="a video, an image folder, a data set, a bag, or `demo`",
    )
    add_setting(parser, InfoSettings(), "--samples", "samples", help="pairs of frames to look at")
    parser.add_argument(
        "--write-mask",
        type=Path,
        metavar="FILE",
        help="write what never changes while the rest of the picture does as a mask, an image for --mask",
    )
    add_sequence_arguments(parser)
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> None:
    """Look at the recording and print what was found."""
    from improvo.sequences.images import IMAGE_SUFFIXES
    from improvo.sequences.survey import survey
    from improvo.terminal import progress

    if arguments.write_mask is not None:
        check_output_file(arguments.write_mask, sorted(IMAGE_SUFFIXES))
    settings = with_found_camera(settings_from(InfoSettings, arguments), [arguments.sequence], None, "info")
    with progress("info", "pair") as shown:
        findings = survey(arguments.sequence, settings.sequence, settings.samples, shown.advance).to_dict()
    lines = [f"{name:<14} {text}" for name, text in _lines(findings)]
    lines += [f"! {problem['what']}\n  -> {problem['advice']}" for problem in findings["problems"]]
    if not findings["problems"]:
        lines.append("nothing wrong was found")
    figures(findings, "\n".join(lines))
    given = [f" --{name} {typed(vars(arguments)[name])}" for name in _CAMERA if vars(arguments).get(name)]
    options = "".join(given) if findings["camera"] else " --camera FILE"
    if arguments.write_mask is not None:
        say(_write_mask(arguments, settings))
        options += f" --mask {typed(arguments.write_mask)}"
    next_step(f"`improvo run {recording_words(arguments.sequence)}{options} -o out`")


def _write_mask(arguments: argparse.Namespace, settings: InfoSettings) -> str:
    """Write the mask of what never changes; what was written, in words."""
    from improvo.files import write_png
    from improvo.sequences.opening import open_recording
    from improvo.sequences.sequence import selected
    from improvo.sequences.still import still_mask

    recording = open_recording(arguments.sequence, settings.sequence)
    mask = still_mask(recording, selected(recording, settings.sequence), settings.samples)
    write_png(arguments.write_mask, mask[..., None].repeat(3, axis=2))
    return f"mask in {arguments.write_mask}: {100 * float((mask == 0).mean()):.1f} % is black; look at it before use"


def _lines(facts: dict[str, Any]) -> list[tuple[str, str]]:
    width, height = facts["size"]
    rate = "unknown rate" if facts["frames_per_second"] is None else f"{facts['frames_per_second']:.4g} per second"
    camera, depth, truth = facts["camera"], facts["depth"], facts["ground_truth"]
    lines = [
        ("recognised as", f"{facts['format']} ({facts['path']})"),
        ("frames", f"{facts['frames']}, {rate}, {facts['seconds']:.2f} s, {width}x{height}"),
        ("camera", "none" if camera is None else _camera(camera)),
    ]
    if camera is not None:
        lines.append(("view", f"{camera['view']}; {camera['horizontal_fov_deg']:.1f} degrees wide"))
    if depth is None:
        lines.append(("depth", "none"))
    else:
        median = "" if depth["median"] is None else f", median {depth['median']:.2f} m"
        lines.append(("depth", f"{100 * depth['share_of_frames']:.0f} % of the frames{median}"))
    if truth is None:
        lines.append(("ground truth", "none"))
    else:
        lines.append(("ground truth", f"{truth['poses']} of {facts['frames']} frames, path {truth['path_length']:.2f}"))
    lines += [
        (
            "pictures",
            f"{100 * facts['duplicates']:.0f} % repeated, {100 * facts['blurred']:.0f} % blurred, "
            f"median grey {facts['brightness']:.0f}, {100 * facts['clipped']:.0f} % clipped, "
            f"{facts['corners']} corners, {facts['sampled']} sampled",
        ),
        ("gaps", str(len(facts["gaps"])) if facts["gaps"] else "none"),
    ]
    return lines + [("note", note) for note in facts["notes"]]


def _camera(camera: dict[str, Any]) -> str:
    text = f"fx {camera['fx']:.6g}, fy {camera['fy']:.6g}, cx {camera['cx']:.6g}, cy {camera['cy']:.6g}"
    if camera["distortion"]:
        values = ", ".join(f"{value:.9g}" for value in camera["distortion"])
        text += f", {camera['distortion_model']} [{values}]"
    return text
