"""Stops commands at random moments (SIGTERM or kill -9), starts them again, and looks at what is left.

    python benchmarks/killed_commands.py [--commands calibrate truth ...] [--stops 6] [--seed 0]

On the bundled recording. Each command runs once in peace. Then it is stopped again and again, each time at a random
moment of what it still had to do, and at last runs to its end. That must end well, with the same results, and leave no
hidden file, lock or process. What was there after a stop must be whole: JSON, YAML, Parquet and weights can be read.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from improvo.frontend.weights_files import load_weights

# 130 in a shell; the others where it came before the command began, or through compiled code that Python remembers
_INTERRUPTED = (130, -signal.SIGTERM, -signal.SIGINT)
SMALL = ["--set", "validation.matches.pairs=10", "--set", "validation.calibration_images=4"]
TRAINED = ["--frontend", "superpoint-small", "--steps", "20", "--batch-size", "2", "--set", "split.share=0.4", *SMALL]
TRAINED += ["--set", "held.optimiser.checkpoint_minutes=0", "--set", "held.optimiser.log_every=1", "--control"]
TRUTH = ["--max-features", "800", "--calibrate", "none"]
FEATURES = ["--frontend", "orb", "--max-keypoints", "500", "--max-frames", "40"]


@dataclass(frozen=True)
class Case:
    """A command, its output below a folder, and which of its files must be the same after stops."""

    words: tuple[str, ...]
    output: str
    same: tuple[str, ...]  # patterns below the folder


CASES = {
    "calibrate": Case(("calibrate", "demo", "--frames", "60"), "camera.yaml", ("camera.yaml",)),
    "truth": Case(
        ("truth", "demo", "--max-frames", "30", *TRUTH),
        "truth.txt",
        ("truth.txt",),
    ),
    "weights-original": Case(("weights", "export", "superpoint-small", "--layout", "original"), "w.pth", ("w.pth",)),
    "weights-transformers": Case(
        ("weights", "export", "superpoint-small", "--layout", "transformers"), "hf", ("hf/*.safetensors",)
    ),
    "features-hloc": Case(
        ("export", "features", "demo", "--layout", "hloc", *FEATURES), "scene", ("scene/pairs.txt", "scene/images/*")
    ),
    "features-colmap": Case(
        ("export", "features", "demo", "--layout", "colmap", *FEATURES), "scene", ("scene/images/*",)
    ),
    "improve": Case(("improve", "demo", *TRAINED), "out", ("**/tracks.parquet", "**/points.parquet", "**/weights.st")),
    "demo": Case(("demo", "--steps", "20"), "out", ("**/tracks.parquet", "**/weights.st")),
}


def start(case: Case, folder: Path) -> subprocess.Popen[str]:
    """The command in a process group of its own."""
    words = [sys.executable, "-m", "improvo", *case.words, "-o", str(folder / case.output), "--quiet"]
    with (folder.with_suffix(".log")).open("w") as log:
        return subprocess.Popen(words, stdout=log, stderr=subprocess.STDOUT, text=True, start_new_session=True)


def contents(case: Case, folder: Path) -> dict[str, bytes]:
    """What must be the same: files byte for byte, weights (`*.st` in a pattern) tensor for tensor."""
    found: dict[str, bytes] = {}
    for pattern in case.same:
        for path in sorted(folder.glob(pattern.replace("weights.st", "weights.safetensors"))):
            name = str(path.relative_to(folder))
            if path.name == "weights.safetensors" and pattern.endswith(".st"):
                tensors = load_weights(path).tensors
                found |= {f"{name}:{key}": np.ascontiguousarray(tensor).tobytes() for key, tensor in tensors.items()}
            else:
                found[name] = path.read_bytes()
    return found


def unreadable(folder: Path) -> list[str]:
    """Files that are there under their own names and are not whole."""
    import pyarrow.parquet as pq
    import yaml

    readers: dict[str, Callable[[Path], object]] = {
        ".json": lambda path: json.loads(path.read_text()),
        ".yaml": lambda path: yaml.safe_load(path.read_text()),
        ".parquet": pq.read_metadata,
        ".safetensors": load_weights,
    }
    bad = []
    for path in sorted(folder.rglob("*")):
        reader = readers.get(path.suffix)
        if reader is None or path.name.startswith(".") or "hf" in path.parts or ".work" in str(path):
            continue
        try:
            reader(path)
        except Exception as error:
            bad.append(f"{path.relative_to(folder)} ({type(error).__name__})")
    return bad


def leftovers(folder: Path) -> list[str]:
    """Hidden files of stopped processes, and locks."""
    names = [path for path in folder.rglob(".*") if ".partial" in path.name or path.name.endswith(".lock")]
    return [str(path.relative_to(folder)) for path in names]


def newest(folder: Path) -> str:
    """The file that was written last, for the table."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return str(max(files, key=lambda path: path.stat().st_mtime_ns).relative_to(folder)) if files else "nothing yet"


def members(group: int) -> int:
    """Processes of a group that still run."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return 0
    return 1


def stop(process: subprocess.Popen[str], number: int) -> tuple[int, float]:
    """End the command, and only it; its status, and how long it took."""
    began = time.monotonic()
    process.send_signal(number)
    status = process.wait(120)
    ends = time.monotonic() + 20
    while members(process.pid) and time.monotonic() < ends:
        time.sleep(0.2)
    if members(process.pid):
        os.killpg(process.pid, signal.SIGKILL)
        raise SystemExit("  FAULT: processes of the command go on without it")
    return status, time.monotonic() - began


def one_case(name: str, stops: int, chance: random.Random, folder: Path) -> bool:
    """Whether all holds."""
    case = CASES[name]
    calm, stopped = folder / f"{name}-calm", folder / f"{name}-stopped"
    calm.mkdir()
    stopped.mkdir()
    began = time.monotonic()
    if start(case, calm).wait():
        print(f"{name}: fails in peace: {calm.with_suffix('.log').read_text()[-300:]}", flush=True)
        return False
    whole = time.monotonic() - began
    print(f"{name}: {whole:.0f} s in peace", flush=True)
    faults: list[str] = []
    for number in range(stops):
        process = start(case, stopped)
        try:
            process.wait(chance.uniform(0.05, 0.9) * whole / (1 + 0.3 * number))
        except subprocess.TimeoutExpired:
            how = chance.choice((signal.SIGTERM, signal.SIGKILL))
            status, seconds = stop(process, how)
            bad = unreadable(stopped)
            faults += [f"half-written: {path}" for path in bad]
            said = stopped.with_suffix(".log").read_text()
            if how is signal.SIGTERM and (status not in _INTERRUPTED or "Traceback" in said):
                faults.append(f"SIGTERM: status {status}: {said[-200:]}")
            print(
                f"  {how.name}: status {status} after {seconds:.1f} s; last {newest(stopped)}; {bad or ''}", flush=True
            )
        else:
            said = stopped.with_suffix(".log").read_text()
            print(f"  came to its end with status {process.returncode}: {said[-120:].strip()}", flush=True)
            break
    if process.poll() != 0:
        process = start(case, stopped)
        if process.wait():
            faults.append(
                f"the last start ends with {process.returncode}: {stopped.with_suffix('.log').read_text()[-300:]}"
            )
    before, after = contents(case, calm), contents(case, stopped)
    if before != after or not before:
        faults.append(
            f"results differ: {sorted(key for key in {*before, *after} if before.get(key) != after.get(key))[:5]}"
        )
    faults += [f"left: {left}" for left in leftovers(stopped)]
    print(f"  {len(before)} results compared; {faults or 'all holds'}", flush=True)
    return not faults


def main() -> None:
    """Command by command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--commands", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--stops", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    chance = random.Random(arguments.seed)
    with tempfile.TemporaryDirectory() as folder:
        held = [one_case(name, arguments.stops, chance, Path(folder)) for name in arguments.commands]
    sys.exit(0 if all(held) else 1)


if __name__ == "__main__":
    main()
