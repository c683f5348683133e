"""Kill `sivo label` and `sivo improve` (which trains) at random moments, start them again, and compare with a calm run.

    python benchmarks/kills.py --kills 10

Works on the bundled recording. Prints for each command how often it was killed where, and whether labels and weights
are the same in the end and no half-written file is left.
"""

from __future__ import annotations

import argparse
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from sivo.frontend.weights import load_weights
from sivo.simulation import bundled_sequence

TABLES = ("tracks.parquet", "points.parquet", "frames.parquet", "trajectory.txt")
COMMANDS = {
    "label": ["--frontend", "superpoint-small"],
    "improve": [
        *("--frontend", "superpoint-small", "--steps", "20", "--batch-size", "2"),
        *("--set", "held_back.share=0.4", "--set", "judge.survival.pairs=10", "--set", "judge.calibration_images=4"),
        *("--set", "training.optimiser.checkpoint_minutes=0", "--set", "training.optimiser.log_every=1"),
    ],
}


def start(command: str, out: Path) -> subprocess.Popen[bytes]:
    """The command in a process of its own."""
    words = [sys.executable, "-m", "sivo", command, str(bundled_sequence()), "-o", str(out), *COMMANDS[command]]
    return subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def finish(command: str, out: Path) -> None:
    """Run the command to its end."""
    if start(command, out).wait():
        raise SystemExit(f"sivo {command} failed in {out}")


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
    """Print the result for both commands."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--command", choices=[*COMMANDS, "both"], default="both")
    arguments = parser.parse_args()
    chance = random.Random(arguments.seed)
    for command in COMMANDS if arguments.command == "both" else [arguments.command]:
        with tempfile.TemporaryDirectory() as folder:
            calm, killed = Path(folder, "calm"), Path(folder, "killed")
            began = time.monotonic()
            finish(command, calm)
            whole = time.monotonic() - began
            print(f"sivo {command}: {whole:.0f} s undisturbed")
            kills = 0
            while kills < arguments.kills:
                process = start(command, killed)
                try:
                    process.wait(chance.uniform(0.1, 0.8) * whole)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
                    kills += 1
                    print(f"  kill {kills}: last written {newest(killed)}", flush=True)
                else:  # it had come to its end: begin anew, so that every kill meets a run at work
                    print("  came to its end; the next begins anew", flush=True)
                    assert contents(killed) == contents(calm), "another result"
                    shutil.rmtree(killed)
            finish(command, killed)
            same = contents(killed) == contents(calm)
            left = [path.name for path in killed.rglob("*.partial*")]
            print(f"  same labels and weights: {same} ({len(contents(calm))} compared); half-written files: {left}")
            if not same or left:
                raise SystemExit(1)


if __name__ == "__main__":
    main()
