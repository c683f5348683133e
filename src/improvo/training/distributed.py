"""Data-parallel training under `torchrun`: every process makes and learns a part of each batch."""

from __future__ import annotations

import atexit
import gc
import os
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import nn


@dataclass(frozen=True)
class Process:
    """This process among those that train together, in the words of `torchrun`."""

    rank: int = 0
    world_size: int = 1

    @staticmethod
    def current() -> Process:
        """From the environment that `torchrun` sets. Without it the process trains alone."""
        return Process(int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1")))

    @property
    def leads(self) -> bool:
        """Whether this process writes the files and shows the progress."""
        return self.rank == 0

    def part_of(self, batch_size: int) -> range:
        """The numbers within a batch that this process makes.

        Together the parts of all processes are the whole batch, and each of its elements is in one part.
        """
        return range(self.rank, batch_size, self.world_size)

    def join(self, device_type: str) -> None:
        """Meet the other processes, until this one ends.

        Args:
            device_type: "cuda" or "cpu", where the gradients lie.
        """
        from torch import distributed

        if self.world_size > 1 and not distributed.is_initialized():
            distributed.init_process_group("nccl" if device_type == "cuda" else "gloo")
            atexit.register(_leave)

    def average_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Replace each gradient by its mean over all processes.

        The processes start from the same weights, so the same steps keep their weights equal.
        """
        if self.world_size == 1:
            return
        import torch
        from torch import distributed

        gradients = [p.grad for p in parameters if p.grad is not None]
        flat = torch.cat([gradient.flatten() for gradient in gradients])
        distributed.all_reduce(flat)
        for gradient, mean in zip(gradients, flat.split([g.numel() for g in gradients]), strict=True):
            gradient.copy_(mean.view_as(gradient) / self.world_size)

    def wait_for_all(self) -> None:
        """Go on when every process has come here."""
        if self.world_size > 1:
            from torch import distributed

            distributed.barrier()


def _leave() -> None:
    """End the threads that spoke to the other processes, while there is an interpreter that they may use.

    Left to the interpreter's end, they abort it now and then. Graphs of past steps are cycles that hold the group,
    and its threads end only when nobody holds it.
    """
    from torch import distributed

    gc.collect()
    if distributed.is_initialized():
        distributed.destroy_process_group()
