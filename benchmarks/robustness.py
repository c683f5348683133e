"""Is the odometry right, or does it say so? Simulated recordings by the dozen, and faults put into real ones.

    python benchmarks/robustness.py --results out --half tune                      # one result file a case; resumable
    python benchmarks/robustness.py --results out --half tune --only overlay       # some of them
    python benchmarks/robustness.py --results out --half report --frontend sift --quick

Rooms: three presets, seven variants (plain, fast turns, walking, near walls, a crowd, wide and narrow lens), strides
1, 3 and 10. Motions: a camera that only turns, or stands. Faults: see `robustness_faults.py`, on a stretch of a real
recording and on the bundled room, 320 pixels wide. Seeds decide what is drawn, RANSAC too: tune on one half, report
the other.

A frame is right if its segment's error is under 3 % of the segment's own path and the turn over a second is under 2°
off. A silent error is a segment of at least 20 frames that is over 5 % wrong, turns otherwise in over half of its
frames, or has a path where there was none, and claims to be right. A false alarm is a segment that was ended, started
anew or doubted though its error was under 3 % and nine tenths of its frames turned as they should. A frame could be
tracked if any of the frontends has it right. A run with poses for pictures that show nothing is SILENT, too.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("LP_NUM_THREADS", "1")  # the software rasteriser's threads

import argparse
import fnmatch
import json
import time
from collections import Counter
from pathlib import Path
from typing import Any

import cv2

from improvo.backend.compile import compile_kernels
from improvo.files import content_hash, write_json
from improvo.frontend.registry import load_frontend
from improvo.odometry.run.second_run import other_kind
from robustness_cases import HALVES, REAL, Case, cases
from robustness_features import FeatureCache
from robustness_measures import NONE, RIGHT, run_and_judge

CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "improvo" / "robustness"
FRONTENDS = ("superpoint-vo", "superpoint-small", "sift")
MAX_KEYPOINTS = 500  # at 320x240


def main() -> None:
    """Run what has no result yet, and print the tables of all results."""
    arguments = parse()
    cv2.setNumThreads(1)
    chosen = [
        case
        for case in cases(arguments.half, arguments.seeds, arguments.real, arguments.quick)
        if not arguments.only or any(fnmatch.fnmatch(case.name, f"*{pattern}*") for pattern in arguments.only)
    ]
    arguments.results.mkdir(parents=True, exist_ok=True)
    missing = [
        (case, name) for case in chosen for name in arguments.frontend if not _file(arguments, case, name).exists()
    ]
    if missing and not arguments.table:
        compile_kernels(print)
        _run(missing, arguments)
    found = [
        json.loads(file.read_text())
        for case in chosen
        for name in arguments.frontend
        if (file := _file(arguments, case, name)).exists()
    ]
    print(tables(found, arguments.frontend))
    write_json(arguments.results / "all.json", found)


def _file(arguments: argparse.Namespace, case: Case, frontend: str) -> Path:
    name = Path(frontend).stem
    if frontend.endswith(".safetensors"):  # files of different folders are often called the same
        name += f"-{content_hash(Path(frontend))[:8]}"
    return Path(arguments.results) / f"{case.name}-{name}.json"


def _run(missing: list[tuple[Case, str]], arguments: argparse.Namespace) -> None:
    names = dict.fromkeys(name for _, name in missing)
    frontends = {name: load_frontend(name, MAX_KEYPOINTS) for name in [*names, *(other_kind(name) for name in names)]}
    folder, keep = arguments.cache / "features", not arguments.no_features
    caches = {name: FeatureCache(folder, each, name, keep) for name, each in frontends.items()}
    clip, clip_case = None, None
    for number, (case, name) in enumerate(missing):
        if clip is None or case != clip_case:
            clip, clip_case = case.clip(arguments.cache, arguments.width), case
        for image in clip.images:  # not part of the time
            caches[name](image)
        start = time.process_time()
        judged = run_and_judge(clip, caches[name], case.seed, caches[other_kind(name)])
        seconds = time.process_time() - start
        about = {"case": case.name, "group": case.group, "what": case.what, "half": case.half, "seed": case.seed}
        content = {**about, "frontend": name, "seconds": round(seconds, 2), **judged.as_json()}
        write_json(_file(arguments, case, name), content)
        errors = ", ".join(
            f"{segment.frames} frames {_number(segment.error_percent)} %{' doubted' if segment.doubt else ''}"
            for segment in judged.segments
        )
        print(f"{number + 1}/{len(missing)} {case.name} {name}: {judged.outcome} ({errors})", flush=True)


def tables(found: list[dict[str, Any]], frontends: list[str]) -> str:
    """Two Markdown tables: counts by frontend and group, and the outcome of each fault."""
    lines = [
        "| frontend | group | runs | segments | silent errors | false alarms | trackable | with a pose | right |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    trackable = _trackable(found)
    groups = list(dict.fromkeys(each["group"] for each in found))
    for frontend in frontends:
        own = [each for each in found if each["frontend"] == frontend]
        for group in [*groups, "all"]:
            chosen = [each for each in own if group in (each["group"], "all")]
            if chosen:
                lines.append(_row(frontend, group, chosen, trackable))
    lines += ["", "| fault or motion | " + " | ".join(frontends) + " |", "|---|" + "---|" * len(frontends)]
    for what in dict.fromkeys(each["what"] for each in found if each["group"] != "rooms"):
        outcomes = [
            Counter(each["outcome"] for each in found if each["what"] == what and each["frontend"] == frontend)
            for frontend in frontends
        ]
        cells = (", ".join(f"{count} {outcome}" for outcome, count in sorted(each.items())) or "-" for each in outcomes)
        lines.append(f"| {what} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _trackable(found: list[dict[str, Any]]) -> dict[str, set[int]]:
    """Frames of each case that at least one frontend has right."""
    frames: dict[str, set[int]] = {}
    for each in found:
        right = {number for number, letter in enumerate(each["frames"]) if letter == RIGHT}
        frames.setdefault(each["case"], set()).update(right)
    return frames


def _row(frontend: str, group: str, chosen: list[dict[str, Any]], trackable: dict[str, set[int]]) -> str:
    segments = [segment for each in chosen for segment in each["segments"] if segment["counts"]]
    silent = sum(segment["silent"] for segment in segments)
    false = sum(alarm["false"] for each in chosen for alarm in each["alarms"])
    frames = [each["frames"][number] for each in chosen for number in sorted(trackable[each["case"]])]
    count = max(len(frames), 1)
    with_pose = 100 * sum(letter != NONE for letter in frames) / count
    right = 100 * sum(letter == RIGHT for letter in frames) / count
    return (
        f"| `{frontend}` | {group} | {len(chosen)} | {len(segments)} | {silent} | {false} | {len(frames)} | "
        f"{with_pose:.1f} % | {right:.1f} % |"
    )


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, required=True, help="folder with a file for each finished case")
    parser.add_argument("--cache", type=Path, default=CACHE, help="rendered rooms and features; default: %(default)s")
    parser.add_argument("--half", nargs="+", choices=tuple(HALVES), default=list(HALVES))
    parser.add_argument("--seeds", type=int, default=1, help="of each half")
    parser.add_argument("--frontend", nargs="+", default=list(FRONTENDS))
    parser.add_argument("--real", nargs="*", default=list(REAL), help="recordings that get the faults")
    parser.add_argument("--width", type=int, default=320, help="pixels of the real recordings")
    parser.add_argument("--only", nargs="+", metavar="PATTERN", help="cases whose name has one of these")
    parser.add_argument("--quick", action="store_true", help="about a tenth of the cases")
    parser.add_argument("--table", action="store_true", help="only the tables of what is finished")
    parser.add_argument("--no-features", action="store_true", help="keep no features in the cache")
    return parser.parse_args()


if __name__ == "__main__":
    main()
