"""Teach a small network by larger ones of ours: python recipes/distil.py pack.zip -o OUT.safetensors --steps 900

The similarities of the keypoints of one frame to those of another one, and to each other, shall be distributed as
those of the teachers, in the mean. Neither poses nor depth are needed: two frames of one source of the pack
(recipes/gpu_pack.py), near each other. First layers, statistics of batch norm and detector are held. What the teachers
say of a frame is said once.
"""

from __future__ import annotations

import argparse
import math
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from improvo.frontend.architecture import CELL
from improvo.frontend.channel_pruning import with_dead_channels, without_dead_channels
from improvo.frontend.network import load_network_frontend, prepare
from improvo.frontend.runtime_torch import load_network
from improvo.frontend.superpoint import SuperPoint, sample_descriptors
from improvo.frontend.weights_files import find_weights, load_weights, save_weights
from improvo.training.data.pack import read_pack
from improvo.training.device import choose_precision
from improvo.training.stages.losses import held_loss
from improvo.types import Float64, UInt8

KEYPOINTS = 500
LEAST = 64  # keypoints of a frame
REACH = 6  # frames of a source between two that are compared
SCALE = 28.0  # inverse temperature of the teachers' similarities
NEAR = 8.0  # pixels; keypoints of a frame nearer than this are not compared with each other
AVERAGE = 0.998
BFLOAT16 = choose_precision("auto", torch.device("cpu")) is torch.bfloat16


@dataclass(frozen=True)
class Frame:
    """What is known of a frame before training."""

    stem: Tensor  # (1, C, h, w) float16, what the frozen layers make of it
    keypoints: Tensor  # (1, N, 2) pixels
    taught: list[Tensor]  # (N, D) float16 unit descriptors of each teacher
    detector: Tensor  # (1, 65, Hc, Wc) float16 logits that are held to


def main() -> None:
    """Train, and write the averaged weights; their ranges for int8 must be measured anew."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pack", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--start", default="superpoint-small")
    parser.add_argument("--teachers", nargs="+", default=["superpoint-vo", "superpoint-small"])
    parser.add_argument("--steps", type=int, default=900)
    parser.add_argument("--most", type=int, default=20, help="frames of a source")
    parser.add_argument("--frozen-layers", type=int, default=6)
    parser.add_argument("--rate", type=float, default=1e-3)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.manual_seed(arguments.seed)
    parent = load_weights(find_weights(arguments.start))
    network = load_network(without_dead_channels(parent)).requires_grad_(False).eval()
    pictures, posed, data = read_pack(arguments.pack)
    sources = [*posed, *pictures.sources]
    chosen = [source.pictures[:: -(-len(source.pictures) // arguments.most)] for source in sources]
    groups = [known_frames(frames, network, arguments) for frames in chosen]
    print(f"{sum(map(len, groups))} frames of {len(groups)} sources", flush=True)
    average = distilled(network, groups, np.array([source.weight for source in sources]), arguments)
    tensors = {name: value.numpy() for name, value in average.state_dict().items()}
    settings = {
        key: value for key, value in vars(arguments).items() if key not in ("pack", "output", "start", "teachers")
    }
    training = {
        "stage": "distil", "start": arguments.start, "teachers": arguments.teachers, **settings,
        "frames": sum(map(len, groups)), "stability_trained": parent.card.training.get("stability_trained", False),
    }  # fmt: skip
    licences = {source.name: source for source in (*parent.card.data, *data)}
    card = replace(parent.card, training=training, data=tuple(licences.values()), metrics={}, activation_ranges={})
    save_weights(arguments.output, with_dead_channels(tensors, parent.architecture), card)


def known_frames(pictures: tuple[UInt8, ...], network: SuperPoint, arguments: argparse.Namespace) -> list[Frame]:
    """The frames that have keypoints."""
    start = load_network_frontend(arguments.start, max_keypoints=KEYPOINTS)
    teachers = [load_network_frontend(name) for name in arguments.teachers]
    found = []
    for picture in pictures:
        height, width = (side // CELL * CELL for side in picture.shape)
        image = np.ascontiguousarray(picture[:height, :width])
        keypoints = torch.from_numpy(start(image).keypoints).float()[None]
        if keypoints.shape[1] < LEAST:
            continue
        seen = prepare(image)[None, None]
        maps = [torch.from_numpy(teacher.runtime(seen).descriptors.copy()).permute(0, 3, 1, 2) for teacher in teachers]
        with torch.no_grad():
            stem = network.encode(torch.from_numpy(seen), 0, arguments.frozen_layers)
            detector = network.detector(network.encode(stem, arguments.frozen_layers))
        taught = [sample_descriptors(values.float(), keypoints)[0].half() for values in maps]
        found.append(Frame(stem.half(), keypoints, taught, detector.half()))
    return found


def distilled(
    network: SuperPoint, groups: list[list[Frame]], weights: Float64, arguments: argparse.Namespace
) -> SuperPoint:
    """The running average of the network in training; sources are drawn by their weights."""
    rng = np.random.default_rng(arguments.seed)
    shares = np.where([len(group) > 1 for group in groups], weights, 0.0)
    shares /= shares.sum()
    trained = [*network.encoder[arguments.frozen_layers :].parameters(), *network.descriptor.parameters()]
    for parameter in trained:
        parameter.requires_grad_(True)
    log_scale = nn.Parameter(torch.tensor(math.log(SCALE)))
    optimiser = torch.optim.AdamW([{"params": trained, "weight_decay": 1e-4}, {"params": [log_scale]}])
    average = deepcopy(network).requires_grad_(False)
    for step in range(arguments.steps):
        group = groups[int(rng.choice(len(groups), p=shares))]
        first = int(rng.integers(len(group)))
        others = [row for row in range(len(group)) if 0 < abs(row - first) <= REACH]
        others = [row for row in others if group[row].stem.shape == group[first].stem.shape]
        if not others:
            continue
        pair = group[first], group[int(rng.choice(others))]
        for part in optimiser.param_groups:
            part["lr"] = arguments.rate * min(1.0, (step + 1) / 100, 2 * (1 - step / arguments.steps))
        loss = pair_loss(network, pair, log_scale.exp(), arguments.frozen_layers)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(trained, 1.0)
        optimiser.step()
        with torch.no_grad():
            for kept, now in zip(average.parameters(), network.parameters(), strict=True):
                kept.lerp_(now, 1 - min(AVERAGE, (1 + step) / (10 + step)))
        if step % 50 == 49:
            print(f"step {step + 1}: loss {float(loss.detach()):.3f}", flush=True)
    return average


def pair_loss(network: SuperPoint, pair: tuple[Frame, Frame], scale: Tensor, frozen: int) -> Tensor:
    """Divergence from the teachers between the frames and within either, and from the detector that is held."""
    with torch.autocast("cpu", torch.bfloat16, enabled=BFLOAT16):
        shared = network.encode(torch.cat([frame.stem.float() for frame in pair]), frozen)
        maps, logits = network.descriptor(shared).float().chunk(2), network.detector(shared).float()
    own = [sample_descriptors(values, frame.keypoints)[0] for values, frame in zip(maps, pair, strict=True)]
    detector = held_loss(logits, torch.cat([frame.detector.float() for frame in pair]))
    between, wanted = scale * own[0] @ own[1].T, similarities(*pair)
    total = detector + divergence(between, wanted) + divergence(between.T, wanted.T)
    for descriptors, frame in zip(own, pair, strict=True):
        near = torch.cdist(frame.keypoints[0], frame.keypoints[0]) < NEAR
        inside = (scale * descriptors @ descriptors.T).masked_fill(near, -1e4)
        total = total + 0.5 * divergence(inside, similarities(frame, frame).masked_fill(near, -1e4))
    return total


def similarities(a: Frame, b: Frame) -> Tensor:
    """(N, M) of the teachers, in the mean."""
    each = [first.float() @ second.float().T for first, second in zip(a.taught, b.taught, strict=True)]
    return SCALE * torch.stack(each).mean(dim=0)


def divergence(own: Tensor, wanted: Tensor) -> Tensor:
    """Kullback-Leibler divergence of the rows' distributions, in the mean over rows."""
    rows = functional.log_softmax(own, dim=1), functional.log_softmax(wanted, dim=1)
    return functional.kl_div(*rows, log_target=True, reduction="batchmean")


if __name__ == "__main__":
    main()
