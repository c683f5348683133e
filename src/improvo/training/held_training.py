"""Training on from given weights, their detector held: from pictures and posed sequences to a folder with weights."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from improvo.errors import InputError
from improvo.frontend.channel_pruning import without_dead_channels
from improvo.frontend.superpoint import SuperPoint
from improvo.frontend.weights_files import DataSource, Weights, load_weights
from improvo.training.batches.device_pairs import DevicePairs
from improvo.training.batches.elsewhere import BUNDLED_SOURCE, HeldElsewhere, bundled_pictures
from improvo.training.batches.teacher import network_teacher
from improvo.training.data.pictures import Pictures
from improvo.training.data.posed_sequence import PosedSequence
from improvo.training.device import choose_device, choose_precision
from improvo.training.held_settings import HeldSettings
from improvo.training.networks import started_network
from improvo.training.output_folder import model_card, not_stated, run_stage
from improvo.training.stages.held import HeldStage
from improvo.training.trainer import Batches


def train_held(
    pictures: Pictures,
    posed: Sequence[PosedSequence],
    settings: HeldSettings,
    output: Path,
    start: Path,
    stability_from: Path | None = None,
    data: tuple[DataSource, ...] = (),
    progress: bool = True,
    seconds: float = 0.0,
    labels: Sequence[Path] = (),
) -> dict[str, Any]:
    """Descriptors from homographies and, between the frames of posed sequences, from depth; the last row of metrics.

    Args:
        start: weights to start from, whose detector is held.
        stability_from: weights whose stability head is held to; without it the result has no such head.
        data: what the model card says about the pictures; the sources' names where it is empty.
        seconds: of preparing and training; where given, the number of steps follows from it.
        labels: label stores, whose tracks teach in every second step; left out where no frame has enough of them, and
            where whole frames teach.
    """
    begun = time.monotonic()
    parent = load_weights(start)
    stability = load_weights(stability_from) if stability_from else None
    if stability and not stability.architecture.stability:
        raise InputError(f"{stability_from}: has no stability head to hold to; use weights that were adapted to VO")
    network = _student(parent, stability, settings)
    device = choose_device(settings.optimiser.device)
    precision = choose_precision(settings.optimiser.precision, device)
    dense = DevicePairs(
        pictures, posed, settings, network_teacher(parent, "detector", device, precision),
        network_teacher(stability, "stability", device, precision) if stability else None, device,
    )  # fmt: skip
    batches = dense if dense.whole else _with_tracks(dense, labels, output)
    if settings.elsewhere.weight:
        batches = HeldElsewhere(batches, bundled_pictures(), parent, stability, settings, device, precision)
    if not data:
        names = (*(source.name for source in pictures.sources), *(sequence.name for sequence in posed))
        data = not_stated(names)
    if settings.elsewhere.weight:
        data = (*data, BUNDLED_SOURCE)
    published = replace(parent.architecture, stability=stability is not None)
    card = model_card(published, "held", settings, data, start)
    card.training.update(
        stability_trained=stability is not None,
        stability_from=stability_from.name if stability_from else "",
        pictures=len(pictures),
        frames=sum(len(sequence.pictures) for sequence in posed),
    )
    card = replace(card, notes="") if stability else card
    left = max(seconds - (time.monotonic() - begun), 0.1) if seconds else 0.0
    return run_stage(HeldStage(network, settings), batches, settings, output, card, progress, left)


def _with_tracks(dense: DevicePairs, labels: Sequence[Path], output: Path) -> Batches:
    from improvo.labeling.labeled import read_labels
    from improvo.training.batches.mixed_pairs import MixedPairs, tracked_settings
    from improvo.training.batches.tracked_pairs import TrackedPairs
    from improvo.training.data.label_library import LabelLibrary

    settings = tracked_settings(dense.settings)
    sequences = [sequence for folder in labels for sequence in read_labels(folder)]
    frames = LabelLibrary(sequences, settings.longer_side, settings.landmarks, output, settings.memory_mib)
    tracked = TrackedPairs(frames, settings)
    return MixedPairs(dense, tracked) if tracked.useful_frames else dense


def _student(parent: Weights, stability: Weights | None, settings: HeldSettings) -> SuperPoint:
    """The parent's network; its stability head, if it gets one, begins as the teacher's where that fits."""
    narrow = without_dead_channels(parent)
    architecture = replace(narrow.architecture, stability=stability is not None)
    network = started_network(architecture, settings.optimiser.seed, parent)
    if stability and not parent.architecture.stability:
        own = network.state_dict()
        head = {name: torch.from_numpy(v) for name, v in stability.tensors.items() if name.startswith("stability.")}
        if all(own[name].shape == values.shape for name, values in head.items()):
            network.load_state_dict(head, strict=False)
    return network
