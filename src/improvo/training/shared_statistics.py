"""What depends on a whole batch, where several processes have a part of it each: batch norm, and how much is averaged.

With both, processes under `torchrun` take the steps that one process takes with all of the batch, to rounding. What
looks at several pairs at once (`negatives_across`, groups of pairs) still looks at those of one process only.
"""

from __future__ import annotations

import torch
from torch import Tensor, distributed, nn

from improvo.training.distributed import Process


def share_of_count(count: Tensor) -> Tensor:
    """What a sum over this process's part is divided by, so that the mean over all processes is that of the batch.

    Args:
        count: () of the items in this part; at least one counts as there in all.
    """
    processes = Process.current().world_size
    if processes == 1 or not distributed.is_initialized():
        return count.clamp(min=1)
    total = count.detach().clone().float()
    distributed.all_reduce(total)
    return total.clamp(min=1) / processes


def share_batch_norm(module: nn.Module) -> None:
    """Let every batch norm within a module take the statistics of all processes' parts; in place."""
    if Process.current().world_size == 1:
        return
    for part in module.modules():
        if type(part) is nn.BatchNorm2d:
            part.__class__ = SharedBatchNorm2d


class SharedBatchNorm2d(nn.BatchNorm2d):
    """Batch norm over the parts of all processes; torch's own works on GPUs only."""

    def forward(self, x: Tensor) -> Tensor:
        """As in torch; (B, C, H, W)."""
        if not self.training:
            return super().forward(x)
        from torch.distributed.nn.functional import all_reduce

        values = x.float()
        number = values.new_tensor([values.numel() / values.shape[1]])
        sums: Tensor = all_reduce(torch.cat([values.sum(dim=(0, 2, 3)), number]))
        count = sums[-1].detach()
        mean = sums[:-1] / count
        centred = values - mean[:, None, None]
        squares: Tensor = all_reduce((centred**2).sum(dim=(0, 2, 3)))
        variance = squares / count
        self._follow(mean.detach(), variance.detach() * count / (count - 1))
        scale = self.weight * torch.rsqrt(variance + self.eps)
        return (centred * scale[:, None, None] + self.bias[:, None, None]).to(x.dtype)

    def _follow(self, mean: Tensor, variance: Tensor) -> None:
        """The running statistics."""
        if self.running_mean is None or self.running_var is None or self.num_batches_tracked is None:
            return
        momentum = 0.1 if self.momentum is None else self.momentum
        with torch.no_grad():
            self.num_batches_tracked += 1
            self.running_mean.lerp_(mean, momentum)
            self.running_var.lerp_(variance, momentum)
