"""Kills `improvo label` at random moments (kill -9) and looks whether it resumes to the same labels.

    python benchmarks/killed_label.py [--kills 10] [--workers 1] [--seed 0]

After every kill, every file that a reader would open must be whole; at the end, all tables must be the bytes of a run
that nobody disturbed, and no temporary file may be left.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pyarrow.parquet as pq
from rendered_walk import write_walk  # of the tests: run with PYTHONPATH=tests

from improvo.labeling.labeled import read_labels
from improvo.labeling.store import read_records

OPTIONS = ["--frontend", "orb", "--max-keypoints", "300", "--set", "labels.min_observations=6", "--pack"]
TABLES = ("tracks.parquet", "points.parquet", "frames.parquet", "trajectory.txt", "map.ply", "images-00000.parquet")


def main() -> None:
    """One run in peace, then one that is killed again and again."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--sequences", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    random_moment = random.Random(arguments.seed)
    folder = Path(tempfile.mkdtemp())
    try:
        walks = [write_walk(folder / f"walk-{seed}", frames=30, seed=seed) for seed in range(arguments.sequences)]
        started = time.monotonic()
        _start(walks, folder / "peace", arguments.workers).wait()
        seconds = time.monotonic() - started
        print(f"undisturbed: {seconds:.1f} s")
        store = folder / "killed"
        for number in range(arguments.kills):
            process = _start(walks, store, arguments.workers)
            # Short, so that work is left for the last kill, and many fall into the start, where the store is opened.
            moment = random_moment.uniform(0, 2 * seconds / len(walks))
            try:
                process.wait(moment)
                print(f"{number + 1:2d}: ended by itself before {moment:.1f} s")
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                print(f"{number + 1:2d}: killed at {moment:4.1f} s; whole: {', '.join(_check(store)) or 'none'}")
        if _start(walks, store, arguments.workers).wait() != 0:
            sys.exit("FAILED: the last run did not succeed")
        _check(store)
        if _tables(store) != _tables(folder / "peace"):
            sys.exit("FAILED: other labels than those of the undisturbed run")
        if leftovers := [str(path) for path in store.rglob("*") if ".partial" in path.name]:
            sys.exit(f"FAILED: left behind: {', '.join(leftovers)}")
        print(f"same {len(_tables(store))} tables, byte for byte; nothing left behind")
    finally:
        shutil.rmtree(folder)


def _start(walks: list[Path], store: Path, workers: int) -> subprocess.Popen[bytes]:
    """The command in a process group of its own, with its workers."""
    command = [sys.executable, "-m", "improvo", "label", *map(str, walks), "-o", str(store), *OPTIONS]
    return subprocess.Popen(
        [*command, "--workers", str(workers)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )


def _check(store: Path) -> list[str]:
    """Read everything that a reader would find; the names of the finished sequences."""
    if not store.is_dir():
        return []
    done = [record.name for record in read_records(store) if record.state == "done"]
    shown = [path.name for path in store.iterdir() if path.is_dir() and not path.name.startswith(".")]
    if sorted(shown) != sorted(done):
        sys.exit(f"FAILED: folders {shown}, but finished are {done}")
    for table in store.glob("[!.]*.parquet"):
        pq.read_table(table)
    if done:
        for sequence in read_labels(store):
            count = len(sequence.frames)
            assert len(sequence.points) > 0
            assert len(sequence.tracks) > 0
            assert sequence.image(count - 1).shape == (240, 320)
    return done


def _tables(store: Path) -> dict[str, bytes]:
    return {str(path.relative_to(store)): path.read_bytes() for path in store.rglob("*") if path.name in TABLES}


if __name__ == "__main__":
    main()
