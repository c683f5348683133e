"""Does the GPU compute what the CPU does, and how fast: python recipes/gpu_check.py pack.zip

Ends with an error if the two differ by more than TOLERANCE. Prints views per second of training (forward, backward,
teachers and the making of the batch), of making batches alone, and of inference.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch
from torch.nn import functional

from improvo.frontend.channel_pruning import without_dead_channels
from improvo.frontend.runtime_torch import load_network
from improvo.frontend.superpoint import heat_map
from improvo.frontend.weights_files import find_weights, load_weights
from improvo.training.batches.device_pairs import DevicePairs
from improvo.training.batches.teacher import network_teacher
from improvo.training.data.pack import read_pack
from improvo.training.data.pictures import Pictures
from improvo.training.device import choose_device
from improvo.training.held_settings import HeldSettings
from improvo.training.metrics import METRICS, read_metrics
from improvo.training.stages.held import HeldStage
from improvo.training.trainer import Trainer

# largest difference of a heat map, and of 1 - cosine of a descriptor (99th percentile), from the CPU in float32
TOLERANCE = {torch.float32: (2e-3, 1e-4), torch.bfloat16: (0.15, 5e-3)}


def agreement(views: torch.Tensor, device: torch.device) -> bool:
    """Compare `superpoint-vo` on views (V, 1, H, W) in [0, 1] between this device and the CPU."""
    network = load_network(load_weights(find_weights("superpoint-vo")))
    with torch.inference_mode():
        wanted = network(views.cpu())
        network = network.to(device, memory_format=torch.channels_last)
        good = True
        for precision, (heat, cosine) in TOLERANCE.items():
            torch.backends.cudnn.allow_tf32 = precision == torch.bfloat16
            with torch.autocast(device.type, torch.bfloat16, enabled=precision == torch.bfloat16):
                given = network(views.to(device))
            maps = [heat_map(output.detector_logits.float().cpu()) for output in (wanted, given)]
            off_heat = float((maps[0] - maps[1]).abs().max())
            similar = functional.cosine_similarity(wanted.descriptors, given.descriptors.float().cpu(), dim=1)
            off_cosine = float((1 - similar).flatten().sort()[0][int(0.99 * similar.numel())])
            fine = off_heat <= heat and off_cosine <= cosine
            good &= fine
            print(f"{precision}: heat differs by {off_heat:.2g} of at most {heat}, 1 - cosine {off_cosine:.2g} of at "
                  f"most {cosine}: {'good' if fine else 'TOO MUCH'}")  # fmt: skip
    return good


def training_rate(name: str, batches: DevicePairs, settings: HeldSettings, steps: int) -> tuple[float, float]:
    """Views per second, and the loss at the end."""
    weights = load_weights(find_weights(name))
    batches.settings = settings
    batches.detector = network_teacher(weights, "detector", batches.device, torch.bfloat16)
    optimiser = replace(settings.optimiser, steps=steps, log_every=steps // 2, checkpoint_minutes=10.0)
    network = load_network(without_dead_channels(weights))
    with tempfile.TemporaryDirectory() as folder:
        trainer = Trainer(HeldStage(network, settings), batches, optimiser, Path(folder))
        trainer.run(progress=False)
        row = read_metrics(Path(folder) / METRICS)[-1]
    return 2 * settings.optimiser.batch_size / row["step_seconds"], row["loss"]


def synchronise(device: torch.device) -> None:
    """Wait for all that was asked for."""
    if device.type == "cuda":
        torch.cuda.synchronize()


def timed(work: object, device: torch.device, repeats: int) -> float:
    """Seconds of one call."""
    assert callable(work)
    work(0)
    synchronise(device)
    begun = time.monotonic()
    for number in range(repeats):
        work(number + 1)
    synchronise(device)
    return (time.monotonic() - begun) / repeats


def main() -> int:
    """Check and time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pack", type=Path)
    parser.add_argument("--batches", nargs="+", type=int, default=[32, 64, 128], help="pairs a step")
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--compile", action="store_true", help="time compiled training too")
    parser.add_argument("--tiny", action="store_true")
    arguments = parser.parse_args()
    device = choose_device("auto")
    begun = time.monotonic()
    print(
        f"torch {torch.__version__} on {torch.cuda.get_device_name() if device.type == 'cuda' else 'CPU'}", flush=True
    )
    pictures, posed, _ = read_pack(arguments.pack)
    settings = HeldSettings()
    if arguments.tiny:
        pictures, posed = Pictures(pictures.sources[:3]), posed[:3]
        settings = replace(settings, views=replace(settings.views, width=64, height=48))
        arguments.batches, arguments.steps = [4, 8], 4
    stability = network_teacher(load_weights(find_weights("superpoint-vo")), "stability", device, torch.bfloat16)
    detector = network_teacher(load_weights(find_weights("superpoint")), "detector", device, torch.bfloat16)
    batches = DevicePairs(pictures, posed, settings, detector, stability, device)
    print(
        f"{len(pictures)} pictures and {len(posed)} sequences ready after {time.monotonic() - begun:.0f} s", flush=True
    )
    with_size = [
        replace(settings, optimiser=replace(settings.optimiser, batch_size=size)) for size in arguments.batches
    ]
    batches.settings = with_size[0]
    views = batches[0]["images"][:8].float() / 255
    good = agreement(views, device)
    torch.set_float32_matmul_precision("high")
    for chosen in with_size:
        batches.settings = chosen
        size = 2 * chosen.optimiser.batch_size
        rate = size / timed(lambda step: batches[step], device, arguments.steps // 4)
        print(f"batches of {size} views, teachers included: {rate:.0f} views/s", flush=True)

    def tell(name: str, used: HeldSettings) -> None:
        rate, loss = training_rate(name, batches, used, arguments.steps)
        told = f"{name}{' compiled' if used.compile else ''}, {used.optimiser.batch_size} pairs a step"
        print(f"{told}: {rate:.0f} views/s, loss {loss:.3f}, at {time.monotonic() - begun:.0f} s", flush=True)

    names = ("superpoint", "superpoint-small")
    for name in names:
        for chosen in with_size:
            tell(name, chosen)
    network = load_network(load_weights(find_weights("superpoint-vo"))).to(device, memory_format=torch.channels_last)
    images = torch.rand(16, 1, 480, 640, device=device)
    with torch.inference_mode(), torch.autocast(device.type, torch.bfloat16):
        rate = 16 / timed(lambda _: network(images), device, 1 if arguments.tiny else 20)
    print(f"inference, 640x480, superpoint-vo: {rate:.0f} images/s; at {time.monotonic() - begun:.0f} s", flush=True)
    for name in names if arguments.compile else ():  # last, as it takes longest
        tell(name, replace(with_size[-1] if len(with_size) < 2 else with_size[1], compile=True))
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
