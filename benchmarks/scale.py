"""What grows with the amount of video: memory, start-up and feeding of training; labelling by several workers.

    python benchmarks/scale.py training --folder TMP [--frames 1000 10000 100000] [--steps 60] [--json FILE]
    python benchmarks/scale.py workers SEQUENCE... --folder TMP
    python benchmarks/scale.py labelling IMAGES --folder TMP [--frames 2000 20000]
    python benchmarks/scale.py plan SEQUENCE... --folder TMP

`training` makes label stores without running odometry (`synthetic_labels.py`) and trains on each in a process of its
own, twice: the first start prepares the labels. `workers` labels the same recordings with one worker and with two, in
turn; it needs two free cores to say anything. `labelling` shows the pictures of a folder forth and back, and measures
the memory of the process that labels them. `plan` compares what `improvo label --plan` says with the processor time
that `improvo label` then takes.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from improvo.files import write_json
from synthetic_labels import write_label_store

_KIB_PER_MIB = 1024


def main() -> None:
    """Measure, print, and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=(*MEASURES, "one-training", "one-labelling"))
    parser.add_argument("sequences", nargs="*", type=Path, help="recordings; a label store for one-training")
    parser.add_argument("--folder", type=Path, required=True, help="for stores and results; kept")
    parser.add_argument("--frames", type=int, nargs="+")
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--width", type=int, help="of the frames to label")
    parser.add_argument("--frontend", default="superpoint", help="weights to train, or to label with")
    parser.add_argument("--json", type=Path, help="write the figures here")
    arguments = parser.parse_args()
    if arguments.what == "one-training":
        print(json.dumps(one_training(arguments.sequences[0], arguments.folder, arguments.steps, arguments.frontend)))
        return
    if arguments.what == "one-labelling":
        recording, width = arguments.sequences[0], arguments.width
        print(json.dumps(one_labelling(recording, arguments.folder, arguments.frontend, width)))
        return
    rows = MEASURES[arguments.what](arguments)
    for row in rows:
        print("  ".join(f"{name} {value}" for name, value in row.items()))
    if arguments.json:
        write_json(arguments.json, {"what": arguments.what, "rows": rows})


def training(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Peak memory, processor time until the first step, and how fast batches are made, by the size of the store."""
    rows = []
    for frames in arguments.frames or (1000, 10_000, 100_000):
        store = write_label_store(arguments.folder / f"labels-{frames}", frames)
        for made in store.glob("*/landmarks-*"):
            made.unlink()
        for start in ("first", "again"):
            output = arguments.folder / f"training-{frames}"
            shutil.rmtree(output, ignore_errors=True)
            options = ["--steps", str(arguments.steps), "--frontend", arguments.frontend]
            found = _in_a_process("one-training", str(store), "--folder", str(output), *options)
            rows.append({"frames": frames, "start": start, **found})
    return rows


def one_training(store: Path, output: Path, steps: int, frontend: str) -> dict[str, Any]:
    """In a process of its own."""
    import numpy as np

    from improvo.frontend.weights_files import find_weights
    from improvo.labeling.labeled import read_labels
    from improvo.training.batches.tracked_pairs import TrackedPairs
    from improvo.training.data.label_library import LabelLibrary
    from improvo.training.odometry_training import train_odometry
    from improvo.training.settings import OdometryTrainingSettings, OptimiserSettings
    from improvo.training.trainer import Trainer

    settings = OdometryTrainingSettings(optimiser=OptimiserSettings(steps=steps, log_every=5))
    begun, first_step = time.process_time(), []
    run = Trainer.run

    def timed(trainer: Trainer, *given: Any, **named: Any) -> Any:
        first_step.append(time.process_time() - begun)
        return run(trainer, *given, **named)

    Trainer.run = timed  # type: ignore[method-assign]
    train_odometry([store], settings, output, find_weights(frontend), progress=False)
    metrics = [json.loads(line) for line in (output / "metrics.jsonl").read_text().splitlines()]
    own, child = (resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    library = LabelLibrary(
        read_labels(store), settings.longer_side, settings.landmarks, output, settings.memory_mib, progress=False
    )
    pairs, count = TrackedPairs(library, settings), 10
    before = time.perf_counter()
    for step in range(count):
        pairs[step]
    feeding = (time.perf_counter() - before) / count
    step_seconds = float(np.median([row["step_seconds"] for row in metrics]))
    return {
        "start_cpu_seconds": round(first_step[0], 2),
        "trainer_mib": own // _KIB_PER_MIB,
        "feeder_mib": child // _KIB_PER_MIB,
        "batch_seconds": round(feeding, 3),
        "step_seconds": round(step_seconds, 3),
        "steps_per_batch_time": round(step_seconds / feeding, 2),
        "loading_share": float(np.median([row["loading_share"] for row in metrics])),
    }


def workers(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Seconds with one worker and with two in turn, and how much of the machine others took meanwhile."""
    rows: list[dict[str, Any]] = []
    for repeat in range(arguments.repeats):
        for count in (1, 2):
            store = arguments.folder / f"labels-by-{count}"
            shutil.rmtree(store, ignore_errors=True)
            command = ["label", *map(str, arguments.sequences), "-o", str(store), "--workers", str(count)]
            command += ["--frontend", arguments.frontend, *_width(arguments)]
            before, own, busy = time.perf_counter(), _children_seconds(), _busy_seconds()
            subprocess.run([sys.executable, "-m", "improvo", *command], check=True, stdout=subprocess.DEVNULL)
            wall, own = time.perf_counter() - before, _children_seconds() - own
            others = _busy_seconds() - busy - own
            row = {"repeat": repeat, "workers": count, "seconds": round(wall, 1), "processor": round(own, 1)}
            rows.append({**row, "others' cores": round(others / wall, 2)})
        one, two = rows[-2:]
        two["times as fast"] = round(one["seconds"] / two["seconds"], 2)
        two["processor ratio"] = round(two["processor"] / one["processor"], 3)
    return rows


def _busy_seconds() -> float:
    """Processor time of everything on this machine since it started."""
    user, nice, system, _, _, irq, soft, steal = map(int, Path("/proc/stat").read_text().split()[1:9])
    return (user + nice + system + irq + soft + steal) / os.sysconf("SC_CLK_TCK")


def labelling(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Peak memory of a process that labels one recording, by its number of frames."""
    pictures = sorted(p for p in arguments.sequences[0].iterdir() if p.suffix in (".png", ".jpg"))
    rows = []
    for frames in arguments.frames or (2000, 20_000):
        recording, output = arguments.folder / f"pictures-{frames}", arguments.folder / f"labelled-{frames}"
        for folder in (recording, output):
            shutil.rmtree(folder, ignore_errors=True)
        recording.mkdir(parents=True)
        for number in range(frames):
            row = number % (2 * len(pictures) - 2)
            picture = pictures[min(row, 2 * len(pictures) - 2 - row)]
            (recording / f"{number:06d}{picture.suffix}").symlink_to(picture.resolve())
        shutil.copy(arguments.sequences[0] / "camera.yaml", recording)
        options = ["--frontend", arguments.frontend, *_width(arguments)]
        rows.append(
            {"frames": frames, **_in_a_process("one-labelling", str(recording), "--folder", str(output), *options)}
        )
    return rows


def one_labelling(recording: Path, output: Path, frontend: str, width: int | None) -> dict[str, Any]:
    """In a process of its own, as a worker does it; memory is looked at every thousand frames."""
    from improvo.frontend.settings import FrontendSettings
    from improvo.jobs.workers import start_worker
    from improvo.labeling.label_sequences import label_sequences
    from improvo.odometry.run_settings import LabelRunSettings
    from improvo.sequences.base import SequenceSettings

    start_worker()
    settings = LabelRunSettings(frontend=FrontendSettings(name=frontend), sequence=SequenceSettings(width=width))
    done, seen = 0, list[int]()

    def on_frames(count: int) -> None:
        nonlocal done
        done += count
        if done % 1000 == 0:
            seen.append(_resident_mib())
            print(done, seen[-1], file=sys.stderr, flush=True)

    (record,) = label_sequences([recording], output, settings, pack=True, on_frames=on_frames)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // _KIB_PER_MIB
    return {"tracked": record.tracked, "peak_mib": peak, "each_1000_frames_mib": seen, "seconds": record.seconds}


def _resident_mib() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") >> 20


def _width(arguments: argparse.Namespace) -> list[str]:
    return [] if arguments.width is None else ["--width", str(arguments.width)]


def plan(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Core-seconds as planned, and as one worker process then takes them."""
    command = [sys.executable, "-m", "improvo", "label", *map(str, arguments.sequences)]
    command += ["--frontend", arguments.frontend, *_width(arguments)]
    said = subprocess.run([*command, "--plan", "--json"], check=True, stdout=subprocess.PIPE, text=True).stdout
    planned = json.loads(said)
    store = arguments.folder / "labels-planned"
    shutil.rmtree(store, ignore_errors=True)
    before = _children_seconds()
    subprocess.run([*command, "-o", str(store)], check=True, stdout=subprocess.DEVNULL)
    taken = _children_seconds() - before
    files = sum(path.stat().st_size for path in store.rglob("*") if path.is_file()) / (1 << 20)
    return [{
        "recordings": planned["recordings"], "frames": planned["frames"],
        "planned core-seconds": round(3600 * planned["core_hours"], 1), "taken": round(taken, 1),
        "planned MiB": planned["storage_mib"], "written": round(files, 1),
    }]  # fmt: skip


def _children_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _in_a_process(*arguments: str) -> dict[str, Any]:
    """The last line that this program prints with these arguments."""
    done = subprocess.run([sys.executable, __file__, *arguments], check=True, stdout=subprocess.PIPE, text=True)
    answer: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return answer


MEASURES = {"training": training, "workers": workers, "labelling": labelling, "plan": plan}

if __name__ == "__main__":
    main()
