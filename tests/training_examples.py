"""A training of a few thousand numbers; needs torch."""

from __future__ import annotations

from pathlib import Path

import torch

from improvo.frontend.architecture import Architecture
from improvo.frontend.superpoint import SuperPoint
from improvo.training.settings import OptimiserSettings, ShapesSettings, ViewSettings
from improvo.training.superpoint_stages import MagicPointStage
from improvo.training.synthetic import ShapeBatches
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
