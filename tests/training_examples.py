"""A training of a few thousand numbers; needs torch."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import torch

from improvo.frontend.architecture import Architecture
from improvo.frontend.superpoint import SuperPoint
from improvo.training.batches.drawn_shapes import ShapeBatches
from improvo.training.settings import OptimiserSettings, ShapesSettings, ViewSettings
from improvo.training.stages.superpoint import MagicPointStage
from improvo.training.trainer import Trainer

TINY = Architecture("tiny", encoder=(4, 4, 4, 4, 8, 8, 8, 8), head=8, descriptor=8, stability=False)


def tiny_trainer(folder: Path, steps: int = 1) -> Trainer:
    """Learns drawn shapes; its checkpoint has about 40 kB."""
    optimiser = OptimiserSettings(
        steps=steps, batch_size=1, warmup_steps=0, decay_steps=1, threads=1, workers=0, checkpoint_minutes=0.0
    )
    settings = ShapesSettings(optimiser=optimiser, views=ViewSettings(height=48, width=64))
    torch.manual_seed(0)
    return Trainer(MagicPointStage(SuperPoint(TINY)), ShapeBatches(settings), optimiser, folder)


@contextmanager
def stopped_after(steps: int) -> Iterator[None]:
    """A training within ends, as by Ctrl-C, where it would make one step more."""
    step, made = Trainer._step, []

    def dies(self: Any, batch: Any) -> Any:
        if len(made) == steps:
            raise KeyboardInterrupt
        made.append(1)
        return step(self, batch)

    with mock.patch.object(Trainer, "_step", dies):
        try:
            yield
        except KeyboardInterrupt:
            return
    raise AssertionError(f"it ends within {steps} steps")
