"""How long the pose protocol takes on cached features: 5,000 pairs (100 sequences of 50), as in the paper.

One RGB-D sequence stands in for all: each of the 100 draws its own pairs from it, so that the work per pair (decoding
depth, matching, two solvers, all measures, bootstrap) is real. Features are computed once, before the clock starts.

    python benchmarks/evaluation.py SEQUENCE [--frontend orb] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from improvo.evaluation.pose.cache import write_cache
from improvo.evaluation.pose.pairs import SequencePairs, pairs_of_sequence
from improvo.evaluation.pose.protocol import ExtractionTask, evaluate_pairs, extract, pair_tasks
from improvo.evaluation.pose.results import results
from improvo.evaluation.pose.run import PoseRun
from improvo.evaluation.settings import PoseSettings
from improvo.evaluation.sources import LoadedFrontend, Recorded
from improvo.jobs.pool import Workers
from improvo.jobs.workers import available_cores
from improvo.types import Features


@dataclass(frozen=True)
class Timing:
    """One run of the protocol."""

    workers: int
    pairs: int
    evaluate_seconds: float
    cpu_seconds: float  # of all processes while evaluating, start of the workers included
    summarise_seconds: float

    @property
    def pairs_per_second(self) -> float:
        """Of both stages together."""
        return self.pairs / (self.evaluate_seconds + self.summarise_seconds)


def draw(source: Recorded, sequences: int, settings: PoseSettings) -> list[SequencePairs]:
    """Pairs of the stand-in sequences: one sequence with another seed each."""
    opened = source.open()
    drawn = []
    for number in range(sequences):
        pairs = pairs_of_sequence(opened, settings.gaps, settings.pairs, settings.seed + number)
        drawn.append(replace(pairs, name=f"{pairs.name}-{number}"))
    return drawn


def cached_features(
    source: Recorded, frontend: LoadedFrontend, sequences: list[SequencePairs], folder: Path, workers: int
) -> Path:
    """Features of all frames that any pair uses."""
    frames = sorted({int(i) for s in sequences for pairs in s.pairs.values() for i in pairs.ravel()})
    tasks = [ExtractionTask(source, frontend, tuple(frames[i : i + 16])) for i in range(0, len(frames), 16)]
    features: dict[int, Features] = {}
    with Workers(workers, progress=True) as pool:
        for found in pool.run(extract, tasks, f"{frontend.label} features"):
            features.update(found)
    write_cache(folder, frontend.fingerprint(), features)
    return folder


def timed(
    source: Recorded, sequences: list[SequencePairs], cache: Path, label: str, settings: PoseSettings, workers: int
) -> Timing:
    """Evaluate all pairs and make the table's rows."""
    tasks = pair_tasks([source] * len(sequences), sequences, [[cache]] * len(sequences), settings)
    cpu = _cpu_seconds()
    with Workers(workers, progress=True) as pool:
        start = time.perf_counter()
        records = np.concatenate(list(pool.run(evaluate_pairs, tasks, f"{workers} workers")))
        middle = time.perf_counter()
    cpu = _cpu_seconds() - cpu
    rows = results(PoseRun(records, sequences, [label], settings, {}))["rows"]
    end = time.perf_counter()
    pairs = sum(row["pairs"] for row in rows) // len(settings.estimators)
    return Timing(workers, pairs, middle - start, cpu, end - middle)


def _cpu_seconds() -> float:
    """Processor time of this process and of those that it started and that have ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def main() -> None:
    """Print the table; with --json write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", metavar="SEQUENCE", help="with depth and true poses")
    parser.add_argument("--frontend", default="orb")
    parser.add_argument("--sequences", type=int, default=100)
    parser.add_argument("--pairs", type=int, default=50)
    parser.add_argument("--gaps", type=int, nargs="+", default=[30])
    parser.add_argument("--workers", type=int, nargs="+", default=sorted({1, available_cores()}))
    parser.add_argument("--json", type=Path, metavar="FILE")
    arguments = parser.parse_args()

    settings = PoseSettings(gaps=tuple(arguments.gaps), pairs=arguments.pairs)
    source, frontend = Recorded(arguments.sequence), LoadedFrontend(arguments.frontend)
    with tempfile.TemporaryDirectory() as folder:
        sequences = draw(source, arguments.sequences, settings)
        cache = cached_features(source, frontend, sequences, Path(folder) / "features", max(arguments.workers))
        timings = [timed(source, sequences, cache, frontend.label, settings, n) for n in arguments.workers]
    print(f"{'workers':>8} {'pairs':>7} {'evaluate (s)':>13} {'CPU (s)':>8} {'summarise (s)':>14} {'pairs/s':>8}")
    for row in timings:
        seconds = f"{row.evaluate_seconds:13.1f} {row.cpu_seconds:8.1f} {row.summarise_seconds:14.2f}"
        print(f"{row.workers:8d} {row.pairs:7d} {seconds} {row.pairs_per_second:8.1f}")
    if arguments.json is not None:
        rows = [{**vars(row), "pairs_per_second": row.pairs_per_second} for row in timings]
        arguments.json.write_text(json.dumps({"frontend": frontend.label, "rows": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
