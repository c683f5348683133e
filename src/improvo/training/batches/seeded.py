"""Batches by number: what a batch holds depends on the seed and on its number only, in whatever process it is made."""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np

from improvo.training.distributed import Process
from improvo.training.settings import OptimiserSettings

Batch = dict[str, np.ndarray]


class _StageSettings(Protocol):
    @property
    def optimiser(self) -> OptimiserSettings: ...


class SeededBatches:
    """As many batches as the optimiser makes steps. Subclasses say what the elements of a batch are.

    A training that was killed makes the same batches again, whatever the number of workers.

    Args:
        settings: of the stage.
    """

    def __init__(self, settings: _StageSettings) -> None:
        self._optimiser = settings.optimiser
        self.process = Process.current()

    def __len__(self) -> int:
        return self._optimiser.steps

    def generators(self, step: int) -> list[np.random.Generator]:
        """A random generator for each element of a batch that this process makes."""
        cv2.setNumThreads(0)  # processes make batches at the same time
        return [np.random.default_rng([self._optimiser.seed, step, number]) for number in self.numbers]

    @property
    def numbers(self) -> range:
        """The numbers within the whole batch, of all processes, of the elements that this process makes."""
        return self.process.part_of(self._optimiser.batch_size)
