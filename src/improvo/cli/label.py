"""Stability labels for many sequences: odometry on each, then the paper's rule on its tracks.

Run again to continue: what is labelled is skipped. One folder per sequence and manifest.parquet are left in LABELS.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from typing import TYPE_CHECKING

from improvo.cli.auto_camera import with_found_camera
from improvo.cli.flags import add_setting
from improvo.cli.options import (
    add_config_arguments,
    add_frontend_arguments,
    add_sequence_arguments,
    check_recordings,
    folder_path,
    recording_path,
    settings_from,
)
from improvo.cli.output import figures, next_step, notice, say, typed
from improvo.cli.plan import duration, say_label_plan
from improvo.errors import ConfigError
from improvo.odometry.run_settings import LabelRunSettings
from improvo.terminal import counted

if TYPE_CHECKING:
    from improvo.labeling.store import SequenceRecord


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo label`."""
    defaults = LabelRunSettings()
    parser.add_argument(
        "sequences", type=recording_path, nargs="+", metavar="SEQUENCE", help="videos, image folders or data sets"
    )
    parser.add_argument("-o", "--output", type=folder_path, metavar="LABELS", help="folder of the label store")
    parser.add_argument(
        "--plan", action="store_true", help="label a short sample only, and say what all of it will cost"
    )
    add_job_arguments(parser)
    parser.add_argument("--pack", action="store_true", help="keep the frames beside the labels, to train elsewhere")
    parser.add_argument(
        "--relabel", action="store_true", help="where LABELS was made with other settings, label all of it anew"
    )
    add_setting(
        parser,
        defaults,
        "--flow-outlier-limit",
        "odometry.matching.flow_outlier_limit",
        metavar="SHARE",
        help="end tracks where a link is farther than this share of the image width from the frame's median motion; "
        "0.1 suits video of 10 frames a second and more (default: 0, never, as in the paper)",
    )
    add_frontend_arguments(parser, defaults)
    add_sequence_arguments(parser)
    add_config_arguments(parser)


def add_job_arguments(parser: argparse.ArgumentParser) -> None:
    """Who does the work on many sequences."""
    parser.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="sequences labelled at a time, a process with one core for each (default: one, on all cores; with --ray, "
        "as many as the cluster has cores)",
    )
    parser.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="label on a Ray cluster (host:port, `auto`, or `local`) whose nodes share these folders",
    )


def run(arguments: argparse.Namespace) -> int:
    """Label what is not labelled yet; 0 unless nothing could be."""
    settings = settings_from(LabelRunSettings, arguments)
    check_recordings(arguments.sequences, settings.sequence)
    from improvo.frontend.registry import check_frontend

    check_frontend(settings.frontend.name, settings.frontend.network)
    if arguments.plan:
        return _plan(arguments, settings)
    if arguments.output is None:
        raise ConfigError("-o LABELS: is missing; it is the folder of the label store")
    from improvo.labeling.label_sequences import label_sequences
    from improvo.labeling.store import DONE
    from improvo.odometry.run.compile import compile_odometry
    from improvo.terminal import progress

    settings = with_found_camera(settings, arguments.sequences, arguments.output, "label")
    compile_odometry(notice)
    total = len(arguments.sequences)
    finished = done_here = 0
    began = time.monotonic()
    with progress(f"label 0/{total}", "frame") as shown:

        def on_record(record: SequenceRecord) -> None:
            nonlocal finished, done_here
            finished += 1
            done_here += time.monotonic() - began > record.seconds  # not before this command began
            shown.describe(f"label {finished}/{total}")
            if done_here and finished < total:
                left = (time.monotonic() - began) / done_here * (total - finished)
                shown.note(f"about {duration(left)} left")
            say(_line(record))

        records = label_sequences(
            arguments.sequences,
            arguments.output,
            settings,
            workers=arguments.workers,
            pack=arguments.pack,
            relabel=arguments.relabel,
            ray=arguments.ray,
            on_record=on_record,
            on_frames=shown.advance,
            on_wait=lambda name, holder: say(f"{name}: {holder} labels it; its result is waited for"),
        )
    done = [record for record in records if record.state == DONE]
    stable, unstable = sum(r.stable for r in done), sum(r.unstable for r in done)
    figures([asdict(record) for record in records], "")
    say(f"{len(done)} of {len(records)} sequences labelled: {stable} stable and {unstable} unstable tracks")
    say(f"labels in {arguments.output}")
    next_step(
        f"`improvo report {typed(arguments.output)}` makes a page of it, "
        f"`improvo train odometry {typed(arguments.output)} -o network` learns from it"
    )
    return 0


def _plan(arguments: argparse.Namespace, settings: LabelRunSettings) -> int:
    """Measure a sample; nothing is left but cameras that were looked for, in the user's cache."""
    from improvo.labeling.plan import plan_labels
    from improvo.odometry.run.compile import compile_odometry
    from improvo.terminal import progress

    settings = with_found_camera(settings, arguments.sequences, None, "label")
    compile_odometry(notice)
    with progress("sample", "frame") as shown:
        plan = plan_labels(arguments.sequences, settings, arguments.pack, shown.advance)
    say_label_plan(plan)
    next_step("the same without --plan and with -o LABELS does it")
    return 0


def _line(record: SequenceRecord) -> str:
    from improvo.labeling.store import DONE

    if record.state != DONE:
        return f"{record.name}: not labelled: {record.reason}"
    poses = f"{record.tracked} of {counted(record.frames, 'frame')} with a pose"
    labels = f"{record.stable} stable, {record.unstable} unstable, {record.ignore} ignored tracks"
    withheld = f", {record.withheld} withheld" if record.withheld else ""
    return f"{record.name}: {poses}; {labels}{withheld}" + (f"; frames: {record.notes}" if record.notes else "")
