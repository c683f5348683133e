"""Kills `improvo improve`, which labels, trains and judges, at random moments (kill -9), and starts it again.

    python benchmarks/killed_improve.py [--kills 10] [--seed 0]

On the bundled recording. At the end the labels must be the bytes, and the weights the numbers, of a run that nobody
disturbed, and no half-written file may be left.
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

import numpy as np

from improvo.frontend.weights_files import load_weights
from improvo.simulation import bundled_sequence

TABLES = ("tracks.parquet", "points.parquet", "frames.parquet", "trajectory.txt")
OPTIONS = [
    *("--frontend", "superpoint-small", "--steps", "20", "--batch-size", "2"),
    *("--set", "split.share=0.4", "--set", "validation.matches.pairs=10", "--set", "validation.calibration_images=4"),
    *("--set", "held.optimiser.checkpoint_minutes=0", "--set", "held.optimiser.log_every=1", "--control"),
]


def start(out: Path) -> subprocess.Popen[bytes]:
    """The command in a process group of its own."""
    words = [sys.executable, "-m", "improvo", "improve", str(bundled_sequence()), "-o", str(out), *OPTIONS]
    return subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)


def finish(out: Path) -> None:
    """Run the command to its end."""
    if start(out).wait():
        raise SystemExit(f"improvo improve failed in {out}")


def contents(out: Path) -> dict[str, bytes]:
    """Labels byte for byte, and all tensors."""
    files = {str(p.relative_to(out)): p.read_bytes() for p in sorted(out.rglob("*")) if p.name in TABLES}
    for path in sorted(out.rglob("weights.safetensors")):
        for name, tensor in load_weights(path).tensors.items():
            files[f"{path.relative_to(out)}:{name}"] = np.ascontiguousarray(tensor).tobytes()
    return files


def newest(out: Path) -> str:
    """The file that was being worked on, for the table."""
    files = [path for path in out.rglob("*") if path.is_file()]
    return str(max(files, key=lambda path: path.stat().st_mtime_ns).relative_to(out)) if files else "nothing yet"


def main() -> None:
    """One run in peace, then one that is killed again and again."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    chance = random.Random(arguments.seed)
    with tempfile.TemporaryDirectory() as folder:
        calm, killed = Path(folder, "calm"), Path(folder, "killed")
        began = time.monotonic()
        finish(calm)
        whole = time.monotonic() - began
        print(f"undisturbed: {whole:.0f} s", flush=True)
        kills = 0
        while kills < arguments.kills:
            process = start(killed)
            try:
                process.wait(chance.uniform(0.1, 0.6) * whole)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                kills += 1
                print(f"kill {kills}: last written {newest(killed)}", flush=True)
            else:  # begin anew, so that every kill meets a run at work
                print(f"came to its end with status {process.returncode}", flush=True)
                compare(calm, killed)
                shutil.rmtree(killed)
        finish(killed)
        compare(calm, killed)


def compare(calm: Path, killed: Path) -> None:
    """Print whether both are the same; end with an error where they are not."""
    ours, theirs = contents(killed), contents(calm)
    left = [path.name for path in killed.rglob("*.partial*")]
    print(f"same labels and weights: {ours == theirs} ({len(theirs)} compared); half-written files: {left}", flush=True)
    if ours != theirs or left or not theirs:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
