"""Pictures of other places, on which descriptors and detector are held to what the start says of them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from improvo.frontend.superpoint import sample_descriptors
from improvo.frontend.weights_files import DataSource, Weights
from improvo.sequences.images import read_grey
from improvo.training.batches.picture_store import PictureStore
from improvo.training.batches.teacher import network_teacher
from improvo.training.batches.view_points import cell_keypoints
from improvo.training.batches.whole_frames import WholeFrames
from improvo.training.distributed import Process
from improvo.training.held_settings import HeldSettings
from improvo.training.trainer import Batches
from improvo.types import UInt8

_BUNDLED = Path(__file__).parents[1] / "bundled" / "elsewhere"
BUNDLED_SOURCE = DataSource("bundled pictures of other places (Poly Haven)", "CC0 1.0")


def bundled_pictures() -> tuple[UInt8, ...]:
    """Grey pictures (240, 320) of thirteen places, which the package has."""
    return tuple(read_grey(file) for file in sorted(_BUNDLED.glob("*.webp")))


class HeldElsewhere:
    """The batches of another source, and with each of them pictures of other places.

    A batch gets `elsewhere` (V, C, h, w), what the frozen layers make of the pictures, or the pictures in [0, 1];
    `elsewhere_points` (V, K, 2) their likeliest keypoints, one a cell, and `elsewhere_descriptors` (V, K, D), what the
    start says there; `elsewhere_detector` (V, 65, Hc, Wc) its logits and, with a teacher of stability,
    `elsewhere_stability` (V, 2, Hc, Wc).

    Args:
        batches: that are trained on.
        pictures: of other places, all of one size.
        start: weights that descriptors and detector are held to.
        stability: weights that stability is held to.
        settings: of the training.
    """

    def __init__(
        self, batches: Batches, pictures: Sequence[UInt8], start: Weights, stability: Weights | None,
        settings: HeldSettings, device: torch.device, precision: torch.dtype,
    ) -> None:  # fmt: skip
        self.batches, self.settings, self.count = batches, settings, len(pictures)
        self._detector = network_teacher(start, "detector", device, precision)
        self._descriptor = network_teacher(start, "descriptor", device, precision)
        self._stability = network_teacher(stability, "stability", device, precision) if stability else None
        self._frames = WholeFrames(PictureStore(pictures, device), self._said, len(pictures))
        self._rank = Process.current().rank

    def __len__(self) -> int:
        return len(self.batches)

    def __getitem__(self, step: int) -> dict[str, Tensor]:
        rng = np.random.default_rng([self.settings.optimiser.seed, step, self._rank, 1])
        rows = rng.choice(self.count, min(self.settings.elsewhere.pictures, self.count), replace=False)
        with torch.no_grad():
            said = self._frames.batch(rows)
        images = said.pop("images")
        seen = said.pop("stem") if self.settings.frozen_layers else images.float() / 255
        return {**self.batches[step], "elsewhere": seen, **{f"elsewhere_{name}": each for name, each in said.items()}}

    def _said(self, images: Tensor) -> dict[str, Tensor]:
        network_input = (images.float() / 255).contiguous(memory_format=torch.channels_last)
        frozen = self.settings.frozen_layers
        logits, stem = self._detector(network_input, frozen)
        places, scores = cell_keypoints(logits)
        best = scores.topk(min(self.settings.elsewhere.points, scores.shape[1]), dim=1)[1]
        points = places.gather(1, best[..., None].expand(-1, -1, 2))
        descriptors = sample_descriptors(self._descriptor(network_input)[0], points)
        said = {"detector": logits, "points": points, "descriptors": descriptors, **({"stem": stem} if frozen else {})}
        return said if self._stability is None else {**said, "stability": self._stability(network_input)[0]}
