"""Data-parallel training under `torchrun`: each process makes and learns its share of every batch."""

from __future__ import annotations

import os
from dataclasses import dataclass


@dataclass(frozen=True)
class Share:
    """This process among those that train together."""

    rank: int = 0
    processes: int = 1

    @staticmethod
    def of_this_process() -> Share:
        """From the environment that `torchrun` sets; alone without it."""
        return Share(int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1")))

    @property
    def leads(self) -> bool:
        """Whether this process writes the files and shows the progress."""
        return self.rank == 0

    def of(self, batch_size: int) -> range:
        """The numbers within a batch that are this process's to do."""
        return range(self.rank, batch_size, self.processes)
