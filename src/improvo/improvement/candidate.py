"""A frontend of the loop with everything that is known of it: the one at the start, or one that a round has taught."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from improvo.errors import ConfigError, InputError
from improvo.frontend.weights import find_weights, load_weights, save_weights
from improvo.improvement.held_back import Part
from improvo.sequences import Sequence as FrameSequence
from improvo.sequences import open_sequence
from improvo.types import UInt8


@dataclass(frozen=True)
class Candidate:
    """One folder of the output.

    NAME/
        weights.safetensors, .json   what it is
        held-back/                   label store of what was held back, made with it
        judgement.json               how good it is; written last
        labels/                      label store of the training part, made with it, once it is the teacher
        training/                    of a round: metrics and checkpoints
        pictures/
    """

    name: str  # "start", "round 1"
    folder: Path

    @property
    def weights(self) -> Path:
        """Its weights file, ready for the same runtime as that of every other candidate."""
        return self.folder / "weights.safetensors"

    @property
    def labels(self) -> Path:
        """Label store of the training part."""
        return self.folder / "labels"

    @property
    def held_back(self) -> Path:
        """Label store of the part to judge by."""
        return self.folder / "held-back"

    @property
    def training(self) -> Path:
        """Where it was trained."""
        return self.folder / "training"

    @property
    def judgement(self) -> Path:
        """How good it is."""
        return self.folder / "judgement.json"


def starting_weights(name: str) -> Path:
    """The weights file that the loop starts from.

    Raises:
        ConfigError: a frontend that has no weights.
        InputError: no such file.
    """
    from improvo.frontend.registry import CLASSICAL

    if name in CLASSICAL:
        raise ConfigError(f"frontend {name}: has no weights to train; choose superpoint, superpoint-small or a file")
    return find_weights(name)


def write_calibrated(source: Path, target: Path, images: Sequence[UInt8]) -> None:
    """Copy weights with activation ranges over the images, so that they run in int8 where that can run them at all."""
    from improvo.frontend.quantisation import calibrate

    weights = load_weights(source)
    if weights.architecture.normalisation != "after_relu":  # int8 has no negative activations
        weights = calibrate(weights, images)
    save_weights(target, weights.tensors, weights.card)


def calibration_images(part: Part, count: int) -> list[UInt8]:
    """About `count` frames, evenly spread over the recordings of the training part; unreadable ones are left out.

    Raises:
        InputError: there is none.
    """
    images = []
    for path in part.paths:
        try:
            sequence = open_sequence(path, part.sequence)
        except InputError:  # said when it is labelled
            continue
        wanted = max(1, round(count / len(part.paths)))
        rows = np.unique(np.linspace(0, len(sequence) - 1, wanted).round().astype(int))
        images += [image for row in rows if (image := _image(sequence, int(row))) is not None]
    if not images:
        raise InputError(f"{part.paths[0]}: none of its frames can be read; check the recording")
    return images


def _image(sequence: FrameSequence, row: int) -> UInt8 | None:
    try:
        return sequence[row].image
    except InputError:
        return None


def publish(best: Candidate, target: Path, words: str, measures: dict[str, float]) -> None:
    """Put the weights of a candidate where the user looks for them, with what they were judged by in their card.

    A file that says so already is left alone.
    """
    weights = load_weights(best.weights)
    metrics = {**weights.card.metrics, "improvement": {"kept": best.name, "rule": words, **measures}}
    card = replace(weights.card, metrics=metrics)
    if target.is_file() and target.with_suffix(".json").is_file():
        written = load_weights(target)
        if written.card == card and all(np.array_equal(written.tensors[k], v) for k, v in weights.tensors.items()):
            return
    save_weights(target, weights.tensors, card)


def training_losses(folder: Path) -> dict[str, list[float]]:
    """The rows of `metrics.jsonl`, by column; empty where nothing was trained."""
    try:
        rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    except FileNotFoundError:
        return {}
    names = [name for name in rows[0] if all(name in row for row in rows)] if rows else []
    return {name: [float(row[name]) for row in rows] for name in names}
