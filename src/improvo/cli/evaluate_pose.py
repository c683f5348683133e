"""3D-to-2D pose estimation on random frame pairs (the paper's Table 1): match, lift image A by its depth, solve for B.

Sequences need depth and true poses. Every frontend gets the same pairs. With -o the features are kept, so that adding
a frontend or a gap computes only what is new.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import zlib
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from improvo.cli.auto_camera import with_found_camera
from improvo.cli.evaluate_options import add_frontend_arguments, add_run_arguments, add_truth_argument
from improvo.cli.options import add_config_arguments, add_sequence_arguments, recording_path, settings_from
from improvo.cli.output import figures, next_after_figures, say
from improvo.errors import PLOTS_MISSING, ConfigError, ImprovoError, InputError, plots_installed
from improvo.evaluation.settings import ESTIMATORS, USUAL_OVERLAPS, PoseCommandSettings, PoseSettings
from improvo.geometry.depth_sampling import SAMPLINGS
from improvo.untrusted.text import read_json_file

if TYPE_CHECKING:
    from improvo.evaluation.sources import FeatureSource, Recorded

COMMAND = "evaluate pose"


_FLAGS = {
    "pairs": "pose.pairs",
    "estimator": "pose.estimators",
    "depth_sampling": "pose.depth_sampling",
    "max_keypoints": "pose.max_keypoints",
    "seed": "pose.seed",
    "shuffles": "pose.shuffles",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `improvo evaluate pose`."""
    defaults, absent = PoseSettings(), argparse.SUPPRESS
    parser.add_argument(
        "sequences", nargs="*", type=recording_path, metavar="SEQUENCE", help="with depth and true poses"
    )
    add_truth_argument(parser)
    add_frontend_arguments(parser, defaults.max_keypoints)
    parser.add_argument(
        "--features",
        action="append",
        default=[],
        metavar="[LABEL=]PATH",
        help="features exported by another program: a folder of NPZ files, or an HDF5 file of hloc; repeatable",
    )
    gaps = " ".join(map(str, defaults.gaps))
    group = parser.add_mutually_exclusive_group()
    group.add_argument(
        "--gaps",
        nargs="+",
        metavar="N",
        help=f"frames between the two images, or seconds such as 1s 2s 3s (default: {gaps} frames; by --overlap where "
        "the recording has fewer than 10 frames a second)",
    )
    group.add_argument(
        "--overlap",
        nargs="+",
        type=float,
        metavar="SHARE",
        help=f"gaps at which the second image still shows so much of the first "
        f"(default: {' '.join(f'{share:g}' for share in USUAL_OVERLAPS)}, those of 30, 60 and 90 frames of a handheld "
        "30 Hz recording)",
    )
    parser.add_argument(
        "--pairs", type=int, default=absent, metavar="N", help=f"per sequence and gap (default: {defaults.pairs})"
    )
    parser.add_argument(
        "--estimator",
        nargs="+",
        choices=ESTIMATORS,
        default=absent,
        help="opencv: default solvePnPRansac, the paper's; poselib: a robust one; usac: "
        f"OpenCV's robust one (default: {' '.join(defaults.estimators)})",
    )
    parser.add_argument(
        "--depth-sampling", choices=SAMPLINGS, default=absent, help=f"(default: {defaults.depth_sampling})"
    )
    parser.add_argument(
        "--shuffles",
        type=int,
        default=absent,
        metavar="N",
        help=f"mean over so many orders of each pair's matches, which takes noise away (default: {defaults.shuffles})",
    )
    parser.add_argument("--per-sequence", action="store_true", help="print the table of each sequence too")
    parser.add_argument("--from", dest="results", type=Path, metavar="POSE.JSON", help="print an earlier run again")
    parser.add_argument("--export-images", type=Path, metavar="DIR", help="write the frames of all pairs, and stop")
    add_run_arguments(parser)
    add_sequence_arguments(parser)
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> int | None:
    """Evaluate, or print again; leaves pose.json, pose.md, curves and pairs.parquet in the output folder."""
    from improvo.evaluation.pose.tables import pose_tables

    if arguments.results is not None:
        results = read_results(arguments.results)
        figures(results, pose_tables(results, arguments.per_sequence))
        folder = arguments.results.parent if arguments.output is None else arguments.output
        _draw(results, folder)
        next_after_figures(folder)
        return 0
    if not arguments.sequences:
        raise InputError("improvo evaluate pose: give a SEQUENCE, or --from POSE.JSON")
    if arguments.export_images is not None:
        return _export(arguments)
    results = _evaluate(arguments)
    figures(results, pose_tables(results, arguments.per_sequence))
    next_after_figures(arguments.output)
    return 0


def read_results(path: Path) -> dict[str, Any]:
    """The content of a `pose.json`.

    Raises:
        InputError: not such a file.
    """
    from improvo.evaluation.pose.tables import check_results

    try:
        results = read_json_file(path, "evaluate again")
        if results["protocol"] != "pose" or not results["rows"]:
            raise KeyError
        check_results(results)
    except (OSError, LookupError, TypeError, ValueError, AttributeError, ArithmeticError, InputError):
        raise InputError(f"{path}: is no pose.json of `improvo evaluate pose`; check the path") from None
    return results


def _evaluate(arguments: argparse.Namespace) -> dict[str, Any]:
    from improvo import __version__
    from improvo.cli.evaluate_options import DEFAULT_FRONTENDS, exported_features, loaded_frontends
    from improvo.evaluation.pose.results import results, write_records
    from improvo.evaluation.pose.run import run_pose_protocol
    from improvo.files import check_output_folder, write_json
    from improvo.folder_lock import working_in
    from improvo.jobs.pool import Workers

    settings, sources = _settings(arguments)
    output: Path | None = arguments.output
    if output is not None:
        check_output_folder(output, COMMAND)
    default = () if arguments.features else DEFAULT_FRONTENDS
    loaded, skipped = loaded_frontends(arguments.frontend, settings.max_keypoints, default)
    exported = exported_features(arguments.features, settings.max_keypoints, one_sequence=len(sources) == 1)
    frontends = [*loaded, *exported]
    request = _request(settings, sources, frontends)
    if output is not None and (output / "pose.json").is_file():
        earlier = read_results(output / "pose.json")
        if earlier.get("request") == json.loads(json.dumps(request)):
            return earlier
    with (
        nullcontext() if output is None else working_in(output, COMMAND),
        tempfile.TemporaryDirectory(prefix="improvo-") as temporary,
        Workers(arguments.workers, progress=True) as workers,
    ):
        cache = (output or Path(temporary)) / "features"
        run = run_pose_protocol(list(sources), frontends, settings, cache, workers)
        found = {
            "protocol": "pose",
            "improvo": __version__,
            **results(run),
            "skipped_frontends": skipped,
            "request": request,
        }
        if output is not None:
            for curves in output.glob("curves-*.png"):  # of an earlier evaluation, by other solvers
                curves.unlink()
            write_records(run, output / "pairs.parquet")
            write_json(output / "pose.json", found)
            _write_text(found, output)
            _draw(found, output)
    return found


def _settings(arguments: argparse.Namespace) -> tuple[PoseSettings, list[Recorded]]:
    """The settings, with gaps in frames, and the sequences."""
    from improvo.cli.evaluate_options import recorded_sequences
    from improvo.evaluation.pose.gaps import is_slow, with_gaps_in_frames

    settings = settings_from(PoseCommandSettings, arguments, _FLAGS, _gap_settings(arguments))
    output = arguments.output if arguments.export_images is None else None
    settings = with_found_camera(settings, arguments.sequences, output, COMMAND)
    sources = recorded_sequences(arguments, settings.sequence)
    chosen = settings.pose
    sequences = [source.open() for source in sources]
    flags = arguments.gaps or arguments.overlap or getattr(arguments, "preset", None)
    fixed = flags or chosen.gap_seconds or chosen.overlaps
    if not fixed and chosen.gaps == PoseSettings().gaps and all(is_slow(sequence) for sequence in sequences):
        chosen = replace(chosen, overlaps=USUAL_OVERLAPS)
    in_frames = with_gaps_in_frames(chosen, sequences, fewer=not fixed)
    if in_frames != chosen:
        asked = " ".join([f"{each:g}s" for each in chosen.gap_seconds] or [f"{each:g}" for each in chosen.overlaps])
        what = "overlaps" if chosen.overlaps else "gaps"
        say(f"{what} {asked} are {' '.join(map(str, in_frames.gaps))} frames")
    return in_frames, sources


def _gap_settings(arguments: argparse.Namespace) -> list[str]:
    """The settings that `--gaps` and `--overlap` stand for.

    Raises:
        ConfigError: neither frames nor seconds, or a mixture.
    """
    if arguments.overlap:
        return [f"pose.overlaps={arguments.overlap}"]
    if not arguments.gaps:
        return []
    in_seconds = [word.endswith("s") for word in arguments.gaps]
    try:
        if all(in_seconds):
            return [f"pose.gap_seconds={[float(word[:-1]) for word in arguments.gaps]}"]
        return [f"pose.gaps={[int(word) for word in arguments.gaps]}"]
    except ValueError:
        words = " ".join(arguments.gaps)
        raise ConfigError(f"--gaps {words}: give frames such as 30 60 90, or seconds such as 1s 2s 3s") from None


def _request(settings: PoseSettings, sources: list[Recorded], frontends: list[FeatureSource]) -> dict[str, Any]:
    """All that decides the result; an earlier result with the same request is printed again."""
    from improvo.config import to_dict
    from improvo.evaluation.sources import sequence_fingerprint
    from improvo.sequences.content import depth_content

    sequences = [source.open() for source in sources]
    truths = {
        sequence.name: zlib.crc32(sequence.ground_truth.world_from_cam.tobytes())
        for sequence in sequences
        if sequence.ground_truth is not None
    }
    return {
        "settings": to_dict(settings),
        "sequences": [
            sequence_fingerprint(source, sequence) for source, sequence in zip(sources, sequences, strict=True)
        ],
        "truth": truths,
        "depth": {sequence.name: depth_content(sequence.recording) for sequence in sequences},
        "frontends": [{"label": frontend.label, **frontend.fingerprint()} for frontend in frontends],
    }


def _write_text(results: dict[str, Any], output: Path) -> None:
    from improvo.evaluation.pose.tables import pose_tables
    from improvo.files import write_text

    write_text(output / "pose.md", pose_tables(results, sequences=len(results["sequences"]) > 1))


def _draw(results: dict[str, Any], output: Path) -> None:
    from improvo.evaluation.plots import draw_pose_curves

    if not plots_installed():
        say(f"without pictures of curves; {PLOTS_MISSING} draws them")
        return
    for estimator in results["settings"]["estimators"]:
        draw_pose_curves(results, estimator, output / f"curves-{estimator}.png")


def _export(arguments: argparse.Namespace) -> int:
    """Write the frames that the evaluation will use, as delivered, for a frontend that runs elsewhere."""

    from improvo.evaluation.pose.pairs import pairs_of_sequence
    from improvo.evaluation.sources import refuse_equal_names
    from improvo.files import check_output_folder, make_output_folder, write_picture

    check_output_folder(arguments.export_images, f"{COMMAND} --export-images")
    settings, sources = _settings(arguments)
    refuse_equal_names("sequences", [source.open().name for source in sources])
    make_output_folder(arguments.export_images, f"{COMMAND} --export-images")
    written = 0
    for source in sources:
        sequence = source.open()
        drawn = pairs_of_sequence(sequence, settings.gaps, settings.pairs, settings.seed)
        folder = arguments.export_images / sequence.name
        folder.mkdir(exist_ok=True)
        for row in sorted({int(i) for pairs in drawn.pairs.values() for i in pairs.ravel()}):
            try:
                frame = sequence[row]
            except ImprovoError:
                continue  # its pairs are left out of the evaluation, too
            write_picture(folder / f"{frame.source_index:06d}.png", frame.image)
            written += 1
    say(f"{written} images in {arguments.export_images}; export features as SEQUENCE/NUMBER.npz beside or elsewhere")
    return 0
