"""Pairs of frames that share tracks, in turn with pairs made on the device, as one stream of batches."""

from __future__ import annotations

import torch
from torch import Tensor

from improvo.training.batches.device_pairs import DevicePairs
from improvo.training.batches.tracked_pairs import TrackedPairs
from improvo.training.held_settings import HeldSettings
from improvo.training.settings import OdometryTrainingSettings, PairSettings


class MixedPairs:
    """Batch number i: of `DevicePairs` where i is even, else of `TrackedPairs` with what the teachers say of its views.

    A batch of tracks has the entries of one of `DevicePairs`, and `negative` (B, N) bool: rows that may be wrong
    partners of others.

    Args:
        dense: makes the even batches, and has the teachers.
        tracked: makes the odd ones, from views of the same size.
    """

    def __init__(self, dense: DevicePairs, tracked: TrackedPairs) -> None:
        self.dense, self.tracked = dense, tracked

    def __len__(self) -> int:
        return len(self.dense)

    def __getitem__(self, step: int) -> dict[str, Tensor]:
        if step % 2 == 0:
            return self.dense[step]
        made = self.tracked[step]
        device = self.dense.device
        names = ("images", "points_a", "points_b", "valid", "negative")
        batch = {name: torch.from_numpy(made[name]).to(device) for name in names}
        pairs = len(batch["valid"])
        batch["scenes"] = torch.zeros(pairs, dtype=torch.int64, device=device)  # may show the same places
        return {**batch, **self.dense.taught(batch["images"])}


def tracked_settings(settings: HeldSettings) -> OdometryTrainingSettings:
    """What `TrackedPairs` needs to make views like those of `DevicePairs`."""
    return OdometryTrainingSettings(
        longer_side=settings.longer_side,
        pairs=PairSettings(points=settings.pairs.points, same_frame_share=0.0),
        optimiser=settings.optimiser,
        views=settings.views,
        photometric=settings.photometric,
    )
