"""`improvo label SEQUENCE... -o LABELS`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from improvo.cli.options import (
    FRONTEND_FLAGS,
    add_config_arguments,
    add_frontend_arguments,
    add_sequence_arguments,
    settings_from,
)
from improvo.odometry.run_settings import LabelRunSettings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `improvo label`."""
    defaults = LabelRunSettings()
    parser.add_argument(
        "sequences", type=Path, nargs="+", metavar="SEQUENCE", help="videos, image folders or data sets"
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="LABELS", help="folder of the label store")
    parser.add_argument(
        "--workers",
        type=int,
        metavar="N",
        help="sequences at a time, a process for each (default: 1; with --ray, the cluster's cores)",
    )
    parser.add_argument(
        "--ray",
        metavar="ADDRESS",
        help="do the work on a Ray cluster (host:port, `auto`, or `local`) whose nodes share these folders",
    )
    parser.add_argument("--pack", action="store_true", help="keep the frames beside the labels, to train elsewhere")
    parser.add_argument(
        "--relabel", action="store_true", help="where LABELS was made with other settings, label all of it anew"
    )
    parser.add_argument(
        "--max-stray",
        type=float,
        default=argparse.SUPPRESS,
        metavar="SHARE",
        help="end tracks where a link is farther than this share of the image width from the frame's median motion; "
        "0.1 suits video of 10 frames a second and more (default: 0, never, as in the paper)",
    )
    add_frontend_arguments(parser, defaults.frontend.name, defaults.frontend.max_keypoints)
    add_sequence_arguments(parser)
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Label what is not labelled yet; 0 unless nothing could be."""
    settings = settings_from(
        LabelRunSettings, arguments, FRONTEND_FLAGS | {"max_stray": "odometry.matching.flow_outlier_limit"}
    )
    from tqdm import tqdm

    from improvo.labeling.label_sequences import label_sequences
    from improvo.labeling.store import DONE, SequenceRecord
    from improvo.odometry.compile import compile_odometry

    compile_odometry(lambda words: print(words, file=sys.stderr))
    total = len(arguments.sequences)
    finished = 0
    with tqdm(unit="frame", desc=f"label 0/{total}", smoothing=0.1, delay=0.5) as bar:

        def on_record(record: SequenceRecord) -> None:
            nonlocal finished
            finished += 1
            bar.set_description(f"label {finished}/{total}")
            with tqdm.external_write_mode():
                print(_line(record))

        def on_frames(count: int) -> None:
            bar.update(count)

        records = label_sequences(
            arguments.sequences,
            arguments.output,
            settings,
            workers=arguments.workers,
            pack=arguments.pack,
            relabel=arguments.relabel,
            ray=arguments.ray,
            on_record=on_record,
            on_frames=on_frames,
        )
    done = [record for record in records if record.state == DONE]
    stable, unstable = sum(r.stable for r in done), sum(r.unstable for r in done)
    print(f"{len(done)} of {len(records)} sequences labelled: {stable} stable and {unstable} unstable tracks")
    print(f"labels in {arguments.output}")
    return 0


def _line(record: object) -> str:
    from improvo.labeling.store import DONE, SequenceRecord

    assert isinstance(record, SequenceRecord)
    if record.state != DONE:
        return f"{record.name}: not labelled: {record.reason}"
    poses = f"{record.tracked} of {record.frames} frames with a pose"
    labels = f"{record.stable} stable, {record.unstable} unstable, {record.ignore} ignored tracks"
    withheld = f", {record.withheld} withheld" if record.withheld else ""
    return f"{record.name}: {poses}; {labels}{withheld}" + (f"; frames: {record.notes}" if record.notes else "")
