"""Give a network a stability head, taught by one that has it: python recipes/distil_head.py pack.zip -o OUT.safetensors

What the teacher says of a cell, stable or not, is what the new head shall say, reading what the encoder makes of the
frame. Encoder and other heads stay as they are, bit for bit, so keypoints and descriptors do. Frames are those of a
pack (recipes/gpu_pack.py); every second one that is wider than 320 pixels is shown at half its size. Of frames of
--rooms, recordings of `improvo simulate`, the head shall say the mean of what the teacher says and what is true.
"""

from __future__ import annotations

import argparse
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from improvo.frontend.architecture import CELL
from improvo.frontend.network import NetworkFrontend, load_network_frontend, prepare
from improvo.frontend.runtime_torch import load_network
from improvo.frontend.superpoint import SuperPoint
from improvo.frontend.weights_files import find_weights, load_weights, save_weights
from improvo.simulation.causes import Cause
from improvo.training.data.pack import read_pack
from improvo.types import Float64, UInt8

CELLS = 14_400  # of the frames of a step, which are all of one size: 12 of 320×240
MOVING = 0.08  # share of unstable in the mean over a frame from which on it is drawn five times as often
RATE, AVERAGE, DROPPED = 2e-3, 0.99, 0.05


@dataclass(frozen=True)
class Frame:
    """What the head reads, and what it shall say."""

    features: Tensor  # (1, C, Hc, Wc) float16, of the encoder
    stable: Tensor  # (1, Hc, Wc) probability


def main() -> None:
    """Train the head, and write the network with it; ranges for int8 must be measured anew."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pack", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--rooms", type=Path, help="folder of recordings of `improvo simulate`; `crowded` teaches most")
    parser.add_argument("--start", default="superpoint-small")
    parser.add_argument("--teacher", default="superpoint-vo")
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)
    parent = load_weights(find_weights(arguments.start))
    architecture = replace(parent.architecture, stability=True)
    network = SuperPoint(architecture).requires_grad_(False).eval()
    network.load_state_dict(load_network(parent).state_dict(), strict=False)
    pictures, posed, data = read_pack(arguments.pack)
    teacher = load_network_frontend(arguments.teacher)
    shown = [(picture, None) for source in (*posed, *pictures.sources) for picture in source.pictures]
    shown += rooms_frames(arguments.rooms) if arguments.rooms else []
    frames = [known_frame(*halved(number, *one), network, teacher) for number, one in enumerate(shown)]
    print(f"{len(frames)} frames", flush=True)
    network.stability = taught_head(network, frames, arguments.steps, arguments.seed)
    tensors = {name: values.numpy() for name, values in network.state_dict().items() if "num_batches" not in name}
    licences = {source.name: source for source in (*parent.card.data, *data)}
    training = {
        "stage": "distil", "start": arguments.start, "stability_from": arguments.teacher, "stability_trained": True,
        "steps": arguments.steps, "seed": arguments.seed, "frames": len(frames),
    }  # fmt: skip
    card = replace(parent.card, architecture=architecture, training=training, data=tuple(licences.values()))
    save_weights(arguments.output, tensors, replace(card, metrics={}, activation_ranges={}))


def rooms_frames(folder: Path, stride: int = 4) -> list[tuple[UInt8, UInt8]]:
    """Every so manieth picture of each room and what is unstable in it, (H, W) 0 or 1."""
    found = []
    for file in sorted(
        file for room in sorted(folder.glob("*/labels")) for file in sorted(room.glob("*.png"))[::stride]
    ):
        picture = cv2.imread(str(file.parents[1] / "rgb" / file.name), cv2.IMREAD_GRAYSCALE)
        causes = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        found.append((picture, np.isin(causes, (Cause.MOVING, Cause.HIGHLIGHT)).astype(np.uint8)))
    return found


def halved(number: int, picture: UInt8, unstable: UInt8 | None) -> tuple[UInt8, UInt8 | None]:
    """Both as they are, or at half the size where the number is odd."""
    if number % 2 == 0 or picture.shape[1] <= 320:
        return picture, unstable
    size = picture.shape[1] // 2, picture.shape[0] // 2
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA), unstable


def known_frame(picture: UInt8, unstable: UInt8 | None, network: SuperPoint, teacher: NetworkFrontend) -> Frame:
    """What the encoder makes of a picture, and what the head shall say of it."""
    height, width = (side // CELL * CELL for side in picture.shape)
    seen = prepare(np.ascontiguousarray(picture[:height, :width]))[None, None]
    logits = torch.from_numpy(teacher.runtime(seen).stability_logits.copy()).float()
    stable = functional.softmax(logits, dim=-1)[..., 1]
    if unstable is not None:
        share = cv2.resize(unstable.astype(np.float32), (width // CELL, height // CELL), interpolation=cv2.INTER_AREA)
        stable = (stable + 1 - torch.from_numpy(share)) / 2
    with torch.no_grad():
        features = network.encode(torch.from_numpy(seen))
    return Frame(features.half(), stable)


def taught_head(network: SuperPoint, frames: list[Frame], steps: int, seed: int) -> nn.Module:
    """The running average of the head in training."""
    rng = np.random.default_rng(seed)
    head = network.stability.requires_grad_(True).train()
    average = deepcopy(head).requires_grad_(False).eval()
    optimiser = torch.optim.AdamW(head.parameters(), lr=RATE, weight_decay=1e-3)
    sizes: dict[tuple[int, ...], list[Frame]] = {}
    for frame in frames:
        sizes.setdefault(tuple(frame.stable.shape), []).append(frame)
    groups = list(sizes.values())
    weights = [
        np.array([5.0 if float(1 - frame.stable.mean()) > MOVING else 1.0 for frame in group]) for group in groups
    ]
    shares: Float64 = np.array([values.sum() for values in weights]) / sum(values.sum() for values in weights)
    for step in range(steps):
        chosen = int(rng.choice(len(groups), p=shares))
        group, count = groups[chosen], max(2, CELLS // groups[chosen][0].stable.numel())
        rows = rng.choice(len(group), size=count, p=weights[chosen] / weights[chosen].sum())
        features = functional.dropout2d(torch.cat([group[row].features.float() for row in rows]), DROPPED)
        loss = head_loss(head(features), torch.cat([group[row].stable for row in rows]))
        for part in optimiser.param_groups:
            part["lr"] = RATE * min(1.0, (step + 1) / 50, 2 * (1 - step / steps))
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        with torch.no_grad():
            for kept, now in zip(average.state_dict().values(), head.state_dict().values(), strict=True):
                if kept.is_floating_point():
                    kept.lerp_(now, 1 - min(AVERAGE, (1 + step) / (10 + step)))
        if step % 100 == 99:
            print(f"step {step + 1}: loss {float(loss.detach()):.3f}", flush=True)
    return average


def head_loss(logits: Tensor, stable: Tensor) -> Tensor:
    """Cross-entropy with the teacher's probabilities, where unstable cells weigh up to four times as much."""
    rows = functional.log_softmax(logits, dim=1)
    weights = 4 - 3 * stable
    return -(weights * (stable * rows[:, 1] + (1 - stable) * rows[:, 0])).sum() / weights.sum()


if __name__ == "__main__":
    main()
