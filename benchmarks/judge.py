"""Whether the judge of `improvo improve` orders weights as the truth does.

    python benchmarks/judge.py OUT... --former OLD.safetensors --frontend NAME=FILE ...   # about 10 s a candidate
    python benchmarks/judge.py OUT... --only --frontend before=superpoint-small --frontend after=FILE

`OUT` are folders of `improvo improve`: each has a reference run with depth, and what was held back. For every candidate
the share of right matches (3 and 8 px) of the frames held back, by the reference, and by the recording's own poses and
depth images where it has them, and their number; then, for each recording and gap, and all gaps together, the rank
correlation (Spearman) of the two over the candidates.
Candidates are the bundled weights, those given, and, without `--only`, sums and spoiled ones of `superpoint-small`.
With `--only` it compares: every row with the first, with 95 % intervals (bootstrap over blocks of neighbouring pairs),
and the correlations of those given where there are ten and more.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import hashlib
import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from scipy.stats import spearmanr

from improvo.evaluation.measures import PairGeometry, relative_motion, right_matches
from improvo.evaluation.pose.pairs import overlapping
from improvo.evaluation.pose.self_truth import FixedRun, choose_pairs
from improvo.evaluation.statistics import Bootstrap
from improvo.files import content_hash
from improvo.frontend.registry import load_frontend
from improvo.frontend.weights_files import find_weights, load_weights
from improvo.improvement.gaps import choose_gaps
from improvo.improvement.reference import HELD_BACK, ReferencePart, reference_parts
from improvo.improvement.rounds import calibration_images, write_calibrated
from improvo.improvement.settings import ValidationSettings
from improvo.improvement.split import read_split
from improvo.labeling.labeled import TRAJECTORY_FILE
from improvo.sequences import open_sequence
from improvo.tracking.matching import mutual_nearest_neighbours
from improvo.types import Features, Float32, Int64
from judge_candidates import written

LIMITS = (3.0, 8.0)
KEYPOINTS = 500
_FEWEST = 10  # candidates whose order says something
_FEWEST_PAIRS = 5  # of a gap: resamples of one pair are all alike, which looks like certainty
# "judge 90" -> of each pair, the share within each limit, then the number; a share also rises where wrong ones are lost
Shares = dict[str, list[list[float]]]


@dataclass(frozen=True)
class Set:
    """The pairs of one recording by which weights are compared."""

    name: str
    part: ReferencePart
    pairs: dict[str, Int64]  # "judge 90", "truth 90" -> (K, 2)
    geometry: Callable[[str, int, int], PairGeometry]


def opened(folder: Path, gaps: tuple[int, ...], most: int) -> list[Set]:
    """The recordings held back in a folder of `improve`."""
    if not (folder / "split.json").is_file():
        raise SystemExit(f"{folder}: is no folder of `improvo improve`")
    split = read_split(folder / "split.json")
    return [
        _set(part, folder, gaps, most) for part in reference_parts(folder / "reference", split.held_back, HELD_BACK)
    ]


def _set(part: ReferencePart, folder: Path, gaps: tuple[int, ...], most: int) -> Set:
    run, settings = part.fixed_run(), ValidationSettings()
    chosen = gaps or choose_gaps(run, settings.overlaps, settings.min_pairs)
    true = _true_run(part)
    pairs = {f"judge {gap}": choose_pairs(run, gap, most) for gap in chosen}
    if true is not None:
        pairs |= {f"truth {gap}": choose_pairs(true, gap, most) for gap in chosen}

    def geometry(kind: str, a: int, b: int) -> PairGeometry:
        chosen = true if kind.startswith("truth") and true is not None else run
        depth = chosen.depth(a)
        motion = relative_motion(chosen.world_from_cam, np.array([[a, b]]))[0]
        return PairGeometry(chosen.camera, motion, np.where(depth > 0, depth, np.nan).astype(np.float32), None)

    pairs = {name: found for name, found in pairs.items() if len(found)}
    return Set(f"{part.name} ({folder.name})", part, pairs, geometry)


def calibrated(name: str, weights: Path, folder: Path, keep: Path) -> Path:
    """Weights with activation ranges, which all others have: measured on frames that were trained on where missing.

    They are kept by name and content: files of different folders are often called the same.
    """
    if load_weights(find_weights(str(weights))).card.activation_ranges:
        return weights
    target = keep / f"{_kept_name(name, weights)}.safetensors"
    if not target.is_file():
        write_calibrated(weights, target, calibration_images(read_split(folder / "split.json").training, 24))
    return target


def _true_run(part: ReferencePart) -> FixedRun | None:
    """The recording's own poses and depth images of the part's frames; None where it has none."""
    sequence = open_sequence(Path(part.labeled.record.path), part.labeled.settings)
    if sequence.ground_truth is None:
        return None
    in_sequence = np.searchsorted(sequence.indices, part.labeled.frames.source_index)  # by frame of the run
    poses = np.full((len(in_sequence), 4, 4), np.nan)
    frames = part.frames[sequence.ground_truth.valid[in_sequence[part.frames]]]
    poses[frames] = sequence.ground_truth.world_from_cam[in_sequence[frames]]

    def depth(frame: int) -> Float32 | None:
        return sequence.depth(int(in_sequence[frame]))

    has_depth = np.zeros(len(in_sequence), np.bool_)
    for frame in frames.tolist():
        found = depth(frame)
        has_depth[frame] = found is not None and bool((found > 0).any())
    if not has_depth.any():
        return None
    segment = np.where(np.isfinite(poses).all(axis=(1, 2)), 0, -1)
    return FixedRun(sequence.camera, poses, segment, has_depth, depth)


def scores_file(keep: Path, chosen: Set, name: str, weights: Path) -> Path:
    """Where the shares of a candidate are kept: by its content, and by the recording, the run and the pairs."""
    digest = hashlib.blake2b(chosen.part.labeled.folder.resolve().as_posix().encode(), digest_size=8)
    digest.update(content_hash(chosen.part.labeled.folder / TRAJECTORY_FILE).encode())
    for words, pairs in chosen.pairs.items():
        digest.update(words.encode() + pairs.tobytes())
    return keep / f"{chosen.part.name}-{digest.hexdigest()}" / f"{_kept_name(name, weights)}.scores.json"


def _kept_name(name: str, weights: Path) -> str:
    return f"{name.replace(' ', '-')}-{content_hash(find_weights(str(weights)))[:16]}"


def shares(chosen: Set, weights: Path) -> Shares:
    """Shares of right matches of every pair."""
    frontend = load_frontend(str(weights), KEYPOINTS)

    @cache
    def features(frame: int) -> Features:
        return chosen.part.features(frontend, frame)

    return {
        name: [_right(chosen.geometry(name, a, b), features(a), features(b)) for a, b in pairs.tolist()]
        for name, pairs in chosen.pairs.items()
    }


def _right(geometry: PairGeometry, a: Features, b: Features) -> list[float]:
    matches = mutual_nearest_neighbours(a, b, max_distance=None)
    points = geometry.points_a(a.keypoints[matches[:, 0]])
    pixels = b.keypoints[matches[:, 1]].astype(np.float64)
    known = np.isfinite(points[:, 2])
    if known.sum() < 4:
        return [0.0 for _ in 2 * LIMITS]
    right = [right_matches(geometry, points[known], pixels[known], limit) for limit in LIMITS]
    return [*(float(each.mean()) for each in right), *(float(each.sum()) for each in right)]


def compared(found: dict[str, Shares], column: int, pairs: dict[str, Int64]) -> None:
    """Every candidate against the first, by the judge and by truth: all gaps with the same weight, then each."""
    first, *others = found
    for name in others:
        cells = []
        for kind in ("judge", "truth"):
            gaps = [gap for gap in found[first] if gap.startswith(kind)]
            if gaps:
                together, *single = (
                    _gain(found[first], found[name], some, column, pairs) for some in (gaps, *([gap] for gap in gaps))
                )
                words = (f"{gap.split()[1]} {gain}" for gap, gain in zip(gaps, single, strict=True))
                cells.append(f"{kind} {together}: {', '.join(words)}")
        what = "share" if column < len(LIMITS) else "number"
        print(f"| {name} | {what}, {LIMITS[column % len(LIMITS)]:g} px | " + " | ".join(cells) + " |")


def _gain(before: Shares, after: Shares, gaps: list[str], column: int, pairs: dict[str, Int64]) -> str:
    base = np.mean([np.mean([pair[column] for pair in before[gap]]) for gap in gaps])
    resampled, differences = [], []
    for number, gap in enumerate(gaps):
        difference = np.array(after[gap])[:, column] - np.array(before[gap])[:, column]
        block = overlapping(pairs[gap])
        resampled.append(Bootstrap(len(difference), number, 1000, 0.95, block).means(difference))
        differences.append(difference.mean())
    gain = f"{100 * np.mean(differences) / base:+.1f} %"
    if min(len(before[gap]) for gap in gaps) < _FEWEST_PAIRS:
        return f"{gain} (too few pairs for an interval)"
    low, high = np.percentile(np.mean(resampled, axis=0), (2.5, 97.5))
    return f"{gain} ({100 * low / base:+.1f} to {100 * high / base:+.1f})"


def correlations(found: dict[str, Shares], spoiled: set[str]) -> None:
    """Rank correlation of judge and truth, over all candidates and over those that are not spoiled."""
    some = next(iter(found.values()))
    gaps = [name.split()[1] for name in some if name.startswith("judge") and f"truth {name.split()[1]}" in some]
    if not gaps or len(found) < _FEWEST:
        return
    print("\n| frames apart | candidates | number | rank correlation: share, 8 px | 3 px | number, 8 px | 3 px |")
    groups = {"all": list(found)}
    if spoiled:
        groups["not spoiled"] = [name for name in found if name not in spoiled]
    for words, chosen in [*((gap, [gap]) for gap in gaps), ("all gaps", gaps)]:
        for group, names in groups.items():
            ranks = []
            for column in (1, 0, 3, 2):
                judge, truth = (
                    [_mean(found[name], kind, chosen, column) for name in names] for kind in ("judge", "truth")
                )
                ranks.append(spearmanr(judge, truth).statistic)
            cells = " | ".join(f"{rank:.3f}" for rank in ranks)
            print(f"| {words} | {group} | {len(names)} | {cells} |")


def _mean(values: Shares, kind: str, gaps: list[str], column: int) -> float:
    return float(np.mean([np.array(values[f"{kind} {gap}"])[:, column].mean() for gap in gaps]))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--frontend", action="append", default=[], metavar="NAME=FILE")
    parser.add_argument("--former", type=Path, help="weights of the layers of superpoint-small, to be mixed with it")
    parser.add_argument("--only", action="store_true", help="compare those given, and nothing else")
    parser.add_argument("--gaps", nargs="*", type=int, default=[], help="frames (default: by overlap)")
    parser.add_argument("--pairs", type=int, default=60, help="of a gap, at most")
    parser.add_argument("--keep", type=Path, help="folder for candidates and shares, used again where they are there")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    given = {name: Path(path) for name, _, path in (entry.partition("=") for entry in arguments.frontend)}
    with tempfile.TemporaryDirectory() as temporary:
        keep = arguments.keep or Path(temporary)
        made = {} if arguments.only else written(keep / "candidates", "superpoint-small", arguments.former)
        bundled = [] if arguments.only else ["superpoint-small", "superpoint", "superpoint-vo"]
        former = {"former": arguments.former} if arguments.former else {}
        candidates = {**{name: Path(name) for name in bundled}, **former, **given, **made}
        for folder in arguments.folders:
            for chosen in opened(folder, tuple(arguments.gaps), arguments.pairs):
                found = {}
                for name, path in candidates.items():
                    file = scores_file(keep, chosen, name, path)
                    if not file.is_file():
                        file.parent.mkdir(parents=True, exist_ok=True)
                        file.write_text(json.dumps(shares(chosen, calibrated(name, path, folder, file.parent))))
                    found[name] = json.loads(file.read_text())
                print(f"\n{chosen.name}: pairs " + ", ".join(f"{name}: {len(p)}" for name, p in chosen.pairs.items()))
                if arguments.only:
                    for column in (1, 0, 3, 2):
                        compared(found, column, chosen.pairs)
                    correlations(found, set())
                    continue
                print("| candidate | " + " | ".join(found[bundled[0]]) + " |")
                for name, values in found.items():
                    means = " | ".join(f"{np.array(pairs)[:, 1].mean():.3f}" for pairs in values.values())
                    print(f"| {name} | {means} |")
                correlations(found, {name for name in made if not name.startswith("mixed")})


if __name__ == "__main__":
    main()
