"""Shows that a change of the code changed no result: digests of what the commands write, before and after.

    python benchmarks/unchanged.py --source ../checkout-before --json before.json
    python benchmarks/unchanged.py --json after.json
    python benchmarks/unchanged.py --compare before.json after.json

Runs odometry, labelling, training and the pose protocol as a user would (`python -m PACKAGE ...`), on the recordings in
`../shared/data` and the one in the package. What is in the JSON file already is not run again. Digests are of contents:
poses, rows of tables (as stored, and sorted), tensors, figures by name; not of times, paths, versions or model cards.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from fnmatch import fnmatch
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from safetensors.numpy import load_file

CHECKOUT = Path(__file__).resolve().parents[1]
RECORDINGS = ("redkitchen", "hololens-office", "checkerboard-desk", "kitti00", "demo")
MODE_SETTINGS = ("odometry.mode", "odometry.initialisation")  # the setting's name now, and before
FRAMES = {"robust": 300, "paper": 100}  # the most of a recording; the paper's mode slows down with time
SHORT_TRAINING = "--steps 30 --batch-size 2 --device cpu --threads 1"
FEW_VIEWS = "--architecture superpoint-small --set adaptation.views=3 --set shapes=20"
NO_RESULTS = {"seconds", "ms", "loading", "path", "paths", "notes", "version", "versions", "date", "host", "commit"}

Digests = dict[str, dict[str, str]]  # file -> part of it -> SHA-256


def all_tasks() -> dict[str, list[str]]:
    """Commands by name; {demo} is that recording's path, {label} the result of `label`, {mode} the setting's name."""
    runs = {
        f"run-{place}-{name}-{mode}": f"run {{{place}}} --frontend {name} --max-frames {n} --set {{mode}}={mode}"
        for place, name, (mode, n) in product(RECORDINGS, ("sift", "superpoint-vo"), FRAMES.items())
    }
    homographies = f"train homographies {{demo}} {FEW_VIEWS} {SHORT_TRAINING}"
    odometry = f"train odometry {{label}} --from superpoint-small {SHORT_TRAINING}"
    tasks = {
        **runs,
        "label": "label {demo} {checkerboard-desk} --max-frames 140",
        "evaluate-pose": "evaluate pose {redkitchen} --pairs 40 --workers 1 --frontend sift --frontend superpoint-vo",
        "train-shapes": f"train shapes {SHORT_TRAINING}",
        "train-homographies": homographies,
        "train-homographies-detector": f"{homographies} --detector superpoint-small",
        "train-odometry": f"{odometry} --pictures {{demo}}",
        "train-odometry-paper": f"{odometry} --preset paper",
    }
    return {name: words.split() for name, words in tasks.items()}


class Runner:
    """Runs tasks of one tree and keeps their digests in a JSON file."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        self._package, self._json = arguments.package, arguments.json.absolute()
        self._folder = self._json.with_suffix("")
        self._folder.mkdir(parents=True, exist_ok=True)
        source = arguments.source.absolute() / "src"
        path = os.pathsep.join(filter(None, [str(source), os.environ.get("PYTHONPATH")]))
        self._environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        bundled = next((source / self._package).rglob("demo/groundtruth.txt"), source / "demo" / "groundtruth.txt")
        recordings = {name: arguments.data.absolute() / name for name in RECORDINGS}
        self._places = {**recordings, "demo": bundled.parent, "label": self._folder / "label"}
        self.results: dict[str, Digests] = json.loads(self._json.read_text()) if self._json.exists() else {}
        self._lock = threading.Lock()
        known = (n for n in MODE_SETTINGS if not self._call(("config", "run", "--set", f"{n}=paper"), "config"))
        self._mode = arguments.mode_setting or next(known, MODE_SETTINGS[0])

    def _call(self, words: Iterable[str], name: str) -> str:
        """What it said last if it failed."""
        log = self._folder / f"{name}.log"
        command = [sys.executable, "-m", self._package, *words]
        with log.open("w") as said:
            status = subprocess.call(command, cwd=self._folder, env=self._environment, stdout=said, stderr=said)
        return "".join(log.read_text().splitlines()[-1:]) or f"status {status}" if status else ""

    def run(self, name: str, words: list[str]) -> bool:
        """Whether its digests are in the file now."""
        missing = [place for place, path in self._places.items() if f"{{{place}}}" in words and not path.is_dir()]
        if missing:
            print(f"{name}: left out, for there is no {', no '.join(missing)}", flush=True)
            return False
        self.results.pop(name, None)
        out, start = self._folder / name, time.monotonic()
        shutil.rmtree(out, ignore_errors=True)
        print(f"{name}: starts", flush=True)
        if error := self._call([*(w.format(**self._places, mode=self._mode) for w in words), "-o", str(out)], name):
            print(f"{name}: FAILED: {error}", flush=True)
            shutil.rmtree(out, ignore_errors=True)
            return False
        digests = digests_of(out)
        with self._lock:
            self.results[name] = digests
            self._json.write_text(json.dumps(self.results, indent=1, sort_keys=True) + "\n")
        print(f"{name}: {len(digests)} files, {time.monotonic() - start:.0f} s", flush=True)
        return True


def digests_of(folder: Path) -> Digests:
    """Of all results in the folder, by their path in it."""
    kinds = {".txt": of_trajectory, ".parquet": of_table, ".safetensors": of_arrays, ".npz": of_arrays}
    kinds |= {".npy": of_arrays, ".json": of_figures, ".jsonl": of_figures, ".ply": of_map}
    found = sorted(p for p in folder.rglob("*") if p.suffix in kinds and not p.name.startswith("."))
    return {str(path.relative_to(folder)): kinds[path.suffix](path) for path in found}


def sha(*parts: bytes | str) -> str:
    """One digest of all parts, each with its length."""
    digest = hashlib.sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        digest.update(len(data).to_bytes(8, "big") + data)
    return digest.hexdigest()


def of_trajectory(path: Path) -> dict[str, str]:
    """Poses, and where segments start; no other comment, for they may name the program and its version."""
    lines = [re.sub(r"^# (segment \d+).*", r"\1", line) for line in path.read_text().splitlines()]
    return {"poses": sha(*(line for line in lines if not line.startswith("#")))}


def of_map(path: Path) -> dict[str, str]:
    """PLY without its comments."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    return {"points": sha(*(line for line in header.splitlines() if not line.startswith(b"comment")), body)}


def of_arrays(path: Path) -> dict[str, str]:
    """Names, types, shapes and bytes, without metadata."""
    loaded = load_file(path) if path.suffix == ".safetensors" else np.load(path)
    arrays = [("", loaded)] if isinstance(loaded, np.ndarray) else [(name, loaded[name]) for name in sorted(loaded)]
    return {"arrays": sha(*(part for n, a in arrays for part in (n, str(a.dtype), str(a.shape), a.tobytes())))}


def of_table(path: Path) -> dict[str, str]:
    """Of the rows as stored, of the sorted rows, and of each column by itself; the order of columns is no matter."""
    table = pq.read_table(path)
    names = [name for name in sorted(table.column_names) if is_result(name)]
    types = {name: table[name].type for name in names}
    values = [(types[n].value_type if pa.types.is_dictionary(types[n]) else types[n]) for n in names]
    plain = table.select(names).cast(pa.schema(list(zip(names, values, strict=True))))

    def digest(rows: pa.Table) -> str:
        return sha(*(part for n in rows.column_names for part in (n, str(types[n]), *_bytes(rows[n]))))

    alone = {f"column {name}": digest(plain.select([name]).sort_by(name)) for name in names}
    return {"stored": digest(plain), "sorted": digest(plain.sort_by([(n, "ascending") for n in names])), **alone}


def _bytes(column: pa.ChunkedArray) -> tuple[bytes, bytes]:
    """Where it is null, and the values."""
    if pa.types.is_primitive(column.type):
        return column.is_null().to_numpy().tobytes(), column.to_numpy().tobytes()
    return b"", repr(column.to_pylist()).encode()


def of_figures(path: Path) -> dict[str, str]:
    """Numbers with their names, a digest for each first two names."""
    texts = path.read_text().splitlines() if path.suffix == ".jsonl" else [path.read_text()]
    groups = defaultdict(list)
    for names, value in figures([json.loads(text) for text in texts]):
        group = ".".join([name for name in names if isinstance(name, str)][:2])
        groups[group].append(json.dumps([names, value]))
    return {group: sha(*sorted(lines)) for group, lines in groups.items()}


def figures(data: Any, names: tuple[str | int, ...] = ()) -> Iterator[tuple[tuple[str | int, ...], Any]]:
    """Numbers, truth values and nulls in nested JSON, each with the names and places that lead to it."""
    if isinstance(data, (dict, list)):
        for name, value in data.items() if isinstance(data, dict) else enumerate(data):
            if not isinstance(name, str) or is_result(name):
                yield from figures(value, (*names, name))
    elif not isinstance(data, str):
        yield names, data


def is_result(name: str) -> bool:
    """Whether a figure or column of this name depends on the input alone."""
    return not (NO_RESULTS & set(name.lower().split("_")) or name.endswith("per_second"))


def compare(before: dict[str, Any], after: dict[str, Any], where: str = "") -> Iterator[str]:
    """A line for everything that differs."""
    different = [key for key in sorted(before.keys() | after.keys()) if before.get(key) != after.get(key)]
    for key in different:
        if key not in before or key not in after:
            yield f"{where}{key} is only in {'AFTER' if key in after else 'BEFORE'}"
        elif isinstance(before[key], dict):
            yield from compare(before[key], after[key], f"{where}{key}: ")
        else:
            yield where + ("same rows in another order" if different == ["stored"] else f"{key} differs")


def main() -> None:
    """Run what is missing, or compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--package", default="improvo")
    parser.add_argument("--source", type=Path, default=CHECKOUT, metavar="DIR", help="checkout whose src is run")
    parser.add_argument("--data", type=Path, default=CHECKOUT.parent / "shared" / "data", metavar="DIR")
    parser.add_argument("--json", type=Path, default=Path("unchanged.json"), help="digests; results go beside it")
    parser.add_argument(
        "--only", nargs="+", default=["*"], metavar="NAME", help="tasks by name, also with *, such as 'run-demo-*'"
    )
    parser.add_argument("--again", action="store_true", help="run also what is in the JSON file already")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="commands at once")
    parser.add_argument("--mode-setting", metavar="NAME", help=f"default: what there is of {', '.join(MODE_SETTINGS)}")
    parser.add_argument("--compare", nargs=2, type=Path, metavar=("BEFORE", "AFTER"))
    arguments = parser.parse_args()
    tasks = {name: words for name, words in all_tasks().items() if any(fnmatch(name, o) for o in arguments.only)}
    if not tasks:
        parser.error(f"--only: no such task; there are {', '.join(all_tasks())}")
    if arguments.compare:
        both = (json.loads(path.read_text()) for path in arguments.compare)
        before, after = ({name: found[name] for name in found.keys() & tasks.keys()} for found in both)
        lines = list(compare(before, after))
        same = sum(before[name] == after.get(name) for name in before)
        print(*lines, f"{same} of {len(before.keys() | after.keys())} tasks with the same results", sep="\n")
        if without := [name for name in tasks if name not in before and name not in after]:
            print(f"without results in either: {', '.join(without)}")
        sys.exit(1 if lines or not same else 0)
    runner = Runner(arguments)
    start = time.monotonic()
    chosen = {name: words for name, words in tasks.items() if arguments.again or name not in runner.results}
    print(f"{len(chosen)} of {len(tasks)} tasks to run", flush=True)
    waves = ([n for n, words in chosen.items() if ("{label}" in words) == late] for late in (False, True))
    with ThreadPoolExecutor(arguments.jobs) as pool:
        done = [each for wave in waves for each in pool.map(runner.run, wave, [chosen[name] for name in wave])]
    print(f"{sum(done)} of {len(done)} done in {time.monotonic() - start:.0f} s")
    sys.exit(0 if all(done) else 1)


if __name__ == "__main__":
    main()
