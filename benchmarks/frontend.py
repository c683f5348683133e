"""What a frame costs: the network's runtimes against torch eager and OpenCV's SIFT, all in one run.

    python benchmarks/frontend.py [--images FOLDER] [--weights NAME_OR_FILE ...] [--threads N] [--json FILE]

Every round times every contender once, so that a busy machine slows all alike; the medians' ratios are what counts.
On a very busy one, `OMP_NUM_THREADS=1 ... --threads 1 --clock processor` counts the processor's time instead of the
clock's, which others cannot take away.
Bundled weights are used where there are any. Random ones cost the same: the decoder is given its full number of
keypoints in either case, and the table says how many there were.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from improvo.frontend.architecture import ARCHITECTURES
from improvo.frontend.channel_pruning import without_dead_channels
from improvo.frontend.classical import ClassicalFrontend
from improvo.frontend.decoding import decode
from improvo.frontend.network import NetworkFrontend, prepare
from improvo.frontend.quantisation import calibrate
from improvo.frontend.settings import NetworkSettings
from improvo.frontend.weights_files import (
    ModelCard,
    Weights,
    bundled_names,
    expected_shapes,
    find_weights,
    load_weights,
)
from improvo.tracking.matching import mutual_nearest_neighbours
from improvo.types import UInt8

SIZES = ((480, 640), (240, 320))
KEYPOINTS = 500
MATMUL_SIDE = 2048
CLOCKS = {"wall": time.perf_counter, "processor": time.process_time}


def main() -> None:
    arguments = parse_arguments()
    cv2.setNumThreads(arguments.threads)
    results = [
        measure(weights, name, pictures(arguments.images, size), arguments)
        for size in SIZES
        for name, weights in contenders(arguments.weights)
    ]
    report = {
        "machine": {
            "processor": processor(),
            "threads": arguments.threads,
            "matmul_gflops": matmul_gflops(CLOCKS[arguments.clock]),
        },
        "rounds": arguments.rounds,
        "clock": arguments.clock,
        "keypoints": KEYPOINTS,
        "results": results,
    }
    print_table(report)
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=2) + "\n")


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__.splitlines()[0], formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--images", type=Path, help="folder of pictures, two of which are used; else made ones")
    parser.add_argument("--weights", nargs="+", default=["superpoint", "superpoint-small"], help="names or files")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--rounds", type=int, default=11)
    parser.add_argument("--clock", choices=list(CLOCKS), default="wall", help="processor: time of all threads together")
    parser.add_argument("--json", type=Path, help="also write the figures there")
    return parser.parse_args()


def contenders(names: list[str]) -> list[tuple[str, Weights]]:
    """The weights to time: files, bundled, or random where a known architecture has none bundled yet."""
    found = []
    for name in names:
        if name in ARCHITECTURES and name not in bundled_names():
            found.append((f"{name} (random)", random_weights(name)))
        else:
            found.append((name, load_weights(find_weights(name))))
    return found


def random_weights(name: str) -> Weights:
    random = np.random.default_rng(0)
    architecture = ARCHITECTURES[name].without_normalisation()
    tensors = {}
    for key, shape in expected_shapes(architecture).items():
        spread = np.sqrt(2 / np.prod(shape[1:])) if len(shape) > 1 else 0.1
        tensors[key] = random.normal(0, spread, shape).astype(np.float32)
    return Weights(ModelCard(architecture, "none"), tensors)


def pictures(folder: Path | None, size: tuple[int, int]) -> tuple[UInt8, UInt8]:
    """Two pictures of that size: the previous and the current frame."""
    height, width = size
    if folder is None:
        blobs = np.random.default_rng(0).integers(0, 256, (height // 4, width // 4 + 2), np.uint8)
        wide = cv2.resize(blobs, (width + 8, height), interpolation=cv2.INTER_CUBIC)
        return wide[:, :-8].copy(), wide[:, 8:].copy()
    paths = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in (".png", ".jpg")]
    read = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths if "depth" not in path.name][:2]
    first, second = (cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA) for image in read)
    return first, second


def measure(weights: Weights, name: str, frames: tuple[UInt8, UInt8], arguments: argparse.Namespace) -> dict[str, Any]:
    """Median milliseconds of everything on one image size."""
    previous, image = frames
    height, width = image.shape
    calibrated = without_dead_channels(weights if weights.card.activation_ranges else calibrate(weights, frames))

    def frontend(**settings: Any) -> NetworkFrontend:
        chosen = NetworkSettings(max_keypoints=KEYPOINTS, threshold=0.0, threads=arguments.threads, **settings)
        return NetworkFrontend(calibrated, chosen)

    float32, int8 = frontend(precision="float32"), frontend(precision="int8")
    sift = ClassicalFrontend("sift", KEYPOINTS)
    batch = prepare(image)[None, None]
    before = int8(previous)
    maps = int8.runtime(batch)  # every later call writes the same numbers into the same arrays
    grey = batch[0, 0]
    features = decode(maps, 0, grey, int8.settings)

    timed: dict[str, Callable[[], Any]] = {
        "prepare": lambda: prepare(image),
        "network, OpenVINO float32": lambda: float32.runtime(batch),
        "network, OpenVINO int8": lambda: int8.runtime(batch),
        "decode": lambda: decode(maps, 0, grey, int8.settings),
        "match": lambda: mutual_nearest_neighbours(before, features, 0.7),
        "frame, float32": lambda: mutual_nearest_neighbours(before, float32(image), 0.7),
        "frame, int8": lambda: mutual_nearest_neighbours(before, int8(image), 0.7),
        "SIFT": lambda: sift(image),
        **torch_contenders(calibrated, batch, arguments.threads),
        **onnx_contenders(calibrated, batch, arguments.threads),
    }
    milliseconds = median_milliseconds(timed, arguments.rounds, CLOCKS[arguments.clock])
    operations = 2 * calibrated.architecture.multiplications(height, width)
    return {
        "weights": name,
        "size": [width, height],
        "keypoints": len(features),
        "sift_keypoints": len(sift(image)),
        "giga_operations": operations / 1e9,
        "milliseconds": milliseconds,
        "gflops": {key: operations / ms / 1e6 for key, ms in milliseconds.items() if key.startswith("network")},
    }


def torch_contenders(weights: Weights, batch: Any, threads: int) -> dict[str, Callable[[], Any]]:
    try:
        import torch
    except ImportError:
        return {}
    from improvo.frontend.runtime_torch import TorchRuntime, load_network

    # Eager as anyone would write it: the module, contiguous, batch norm in evaluation mode where there is one.
    eager, channels_last = load_network(weights), TorchRuntime(weights, threads=threads)
    image = torch.from_numpy(batch)

    def run_eager() -> Any:
        with torch.inference_mode():
            return eager(image)

    return {
        "network, torch eager": run_eager,
        "network, torch folded and channels-last": lambda: channels_last(batch),
    }


def onnx_contenders(weights: Weights, batch: Any, threads: int) -> dict[str, Callable[[], Any]]:
    try:
        import onnx  # noqa: F401
        import onnxruntime
    except ImportError:
        return {}
    from tempfile import TemporaryDirectory

    from improvo.export.onnx import export_onnx

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    with TemporaryDirectory() as folder:
        path = Path(folder) / "network.onnx"
        export_onnx(weights, path, NetworkSettings(max_keypoints=KEYPOINTS, threshold=0.0))
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    return {"network and decoding, ONNX Runtime float32": lambda: session.run(None, {"image": batch})}


def median_milliseconds(
    timed: dict[str, Callable[[], Any]], rounds: int, clock: Callable[[], float]
) -> dict[str, float]:
    seconds: dict[str, list[float]] = {name: [] for name in timed}
    for step in range(rounds + 1):
        for name, function in timed.items():
            start = clock()
            function()
            if step:  # the first round warms up
                seconds[name].append(clock() - start)
    return {name: 1e3 * float(np.median(values)) for name, values in seconds.items()}


def matmul_gflops(clock: Callable[[], float]) -> float:
    """The machine's best on a float32 product of matrices, with the threads that NumPy uses."""
    matrix = np.random.default_rng(0).random((MATMUL_SIDE, MATMUL_SIDE), np.float32)
    times = []
    for _ in range(7):
        start = clock()
        matrix @ matrix
        times.append(clock() - start)
    return 2e-9 * MATMUL_SIDE**3 / min(times)


def processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


def print_table(report: dict[str, Any]) -> None:
    machine = report["machine"]
    print(
        f"{machine['processor']}, {machine['threads']} threads, float32 matmul {machine['matmul_gflops']:.0f} GFLOP/s"
    )
    for result in report["results"]:
        milliseconds = result["milliseconds"]
        width, height = result["size"]
        print(
            f"\n{result['weights']}, {width}x{height}, {result['keypoints']} keypoints "
            f"(SIFT {result['sift_keypoints']})"
        )
        for name, value in milliseconds.items():
            rate = result["gflops"].get(name)
            share = f"  {rate:6.0f} GFLOP/s, {rate / machine['matmul_gflops']:.2f} of matmul" if rate else ""
            print(f"  {name:<44}{value:8.2f} ms{share}")
        eager = milliseconds.get("network, torch eager")
        for precision in ("float32", "int8"):
            network, frame = milliseconds[f"network, OpenVINO {precision}"], milliseconds[f"frame, {precision}"]
            faster = f"{eager / network:.1f} times torch eager; " if eager else ""
            print(
                f"  {precision}: {faster}frame {frame / milliseconds['SIFT']:.2f} of SIFT; "
                f"decoding {milliseconds['decode'] / frame:.3f} of the frame"
            )


if __name__ == "__main__":
    sys.exit(main())
