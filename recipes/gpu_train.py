"""Train all bundled weights on one GPU within a given time: python recipes/gpu_train.py pack.zip -o OUT --seconds 540

The jobs of recipes/gpu-plan.yaml, each in a process of its own. One that starts from another's weights waits until
those are done. OUT gets the averaged weights of each job whenever they are saved, and metrics.json; the checkpoints lie
in --work, from which the same command continues.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
import traceback
from functools import reduce
from pathlib import Path
from typing import Any

import yaml

from improvo import files
from improvo.config import from_dict, over
from improvo.frontend.weights_files import find_weights
from improvo.training.held_settings import HeldSettings
from improvo.training.metrics import METRICS, read_metrics

HERE = Path(__file__).parent
WEIGHTS = "weights.safetensors"
DONE = "done"
ERROR = "error.txt"
END_SECONDS = 6.0  # kept for saving the last weights


def settings_of(job: dict[str, Any], plan: dict[str, Any], arguments: argparse.Namespace) -> HeldSettings:
    """The settings of one job."""
    parts = (plan["common"], plan["tiny"] if arguments.tiny else {}, job.get("settings", {}))
    given = reduce(over, (*parts, {"compile": arguments.compile}))
    return from_dict(HeldSettings, given, where=job["name"])


def run_job(job: dict[str, Any], plan: dict[str, Any], arguments: argparse.Namespace) -> None:
    """Wait for the weights that the job starts from, and train."""
    import torch

    from improvo.training.data.pack import read_pack
    from improvo.training.data.pictures import Pictures
    from improvo.training.held_training import train_held

    folder: Path = arguments.work / job["name"]
    pictures, posed, data = read_pack(arguments.pack)
    if arguments.tiny:
        pictures, posed = Pictures(pictures.sources[:3]), posed[:3]
    settings = settings_of(job, plan, arguments)
    torch.set_float32_matmul_precision("high")
    kind, _, parent = job["start"].rpartition(" ")
    start = arguments.work / parent / WEIGHTS if kind == "job" else find_weights(job["start"])
    while kind == "job" and not (arguments.work / parent / DONE).exists():
        if (arguments.work / parent / ERROR).exists():
            raise RuntimeError(f"job {parent} failed")
        time.sleep(0.2)
    if (folder / DONE).exists():
        return
    stability = job.get("stability_from")
    left = arguments.begun + job["until"] * arguments.seconds - END_SECONDS - time.time()
    row = train_held(
        pictures, posed, settings, folder, start, find_weights(stability) if stability else None, data,
        progress=False, seconds=max(left, 1.0),
    )  # fmt: skip
    files.write_json(folder / DONE, row)


def collect(jobs: list[dict[str, Any]], arguments: argparse.Namespace) -> list[str]:
    """Copy what has been saved to OUT; a line on each job."""
    told, metrics = [], {}
    for job in jobs:
        folder = arguments.work / job["name"]
        weights, table = folder / WEIGHTS, folder / METRICS
        copy = arguments.output / f"{job['name']}.safetensors"
        if weights.is_file() and (not copy.exists() or copy.stat().st_mtime < weights.stat().st_mtime):
            with files.written_atomically(copy) as temporary:
                temporary.write_bytes(weights.read_bytes())
        rows = read_metrics(table)
        metrics[job["name"]] = rows
        if rows:
            names = ("step", "loss", "descriptor", "detector", "stability", "right", "step_seconds")
            last = {name: rows[-1][name] for name in names if name in rows[-1]}
            told.append(f"{job['name']}: {' '.join(f'{name} {value:.4g}' for name, value in last.items())}")
        if (folder / ERROR).exists():
            told.append(f"{job['name']} FAILED: {(folder / ERROR).read_text().strip().splitlines()[-1]}")
    # rows of all jobs, thinned to at most 400 each: the curves, not every point
    thin = {name: rows[:: len(rows) // 400 + 1] for name, rows in metrics.items()}
    files.write_text(arguments.output / "metrics.json", json.dumps(thin))
    return told


def main() -> int:
    """Start all jobs, and collect until they end."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pack", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--seconds", type=float, default=540.0, help="for all jobs together")
    parser.add_argument("--plan", type=Path, default=HERE / "gpu-plan.yaml")
    parser.add_argument("--work", type=Path, default=Path("/tmp/improvo-gpu"))
    parser.add_argument("--only", nargs="+", metavar="JOB", help="leave the others out")
    parser.add_argument("--tiny", action="store_true", help="tiny views and batches, to try everything on a CPU")
    parser.add_argument("--compile", action="store_true", help="let torch fuse the networks' operations")
    parser.add_argument("--job", help=argparse.SUPPRESS)
    parser.add_argument("--begun", type=float, default=time.time(), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    plan = yaml.safe_load(arguments.plan.read_text())
    jobs = [job for job in plan["jobs"] if not arguments.only or job["name"] in arguments.only]
    if arguments.job:
        job = next(job for job in jobs if job["name"] == arguments.job)
        try:
            run_job(job, plan, arguments)
        except Exception:
            files.write_text(arguments.work / job["name"] / ERROR, traceback.format_exc())
            raise
        return 0
    arguments.output.mkdir(parents=True, exist_ok=True)
    for job in jobs:
        settings_of(job, plan, arguments)  # so that a wrong plan fails before anything starts
        (arguments.work / job["name"]).mkdir(parents=True, exist_ok=True)
        (arguments.work / job["name"] / ERROR).unlink(missing_ok=True)
    command = [sys.executable, __file__, *sys.argv[1:], "--begun", str(arguments.begun), "--job"]
    processes = [subprocess.Popen([*command, job["name"]], stdout=sys.stderr) for job in jobs]
    told = 0.0
    while any(process.poll() is None for process in processes):
        time.sleep(2 if arguments.tiny else 5)
        lines = collect(jobs, arguments)
        if time.time() - told > 30:
            told = time.time()
            print(f"-- {told - arguments.begun:.0f} s\n" + "\n".join(lines), flush=True)
    print("\n".join(["-- end", *collect(jobs, arguments)]))
    return max(abs(process.returncode) for process in processes)


if __name__ == "__main__":
    sys.exit(main())
