"""The frames of posed sequences where the network runs: which pixel of one shows what a pixel of another shows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from improvo.training.batches.picture_store import DepthStore
from improvo.training.batches.view_points import FAR
from improvo.training.data.posed_sequence import PosedSequence
from improvo.training.device import on_device
from improvo.types import Float64, Int64

_SIDE = 3.0  # pixels from a place to those that tell how the surface about it is seen
_SAME_SURFACE = 0.03  # of their inverse depths, relative


class Carried(NamedTuple):
    """Places (P, N, 2) of frames a in frames b."""

    places: Tensor  # (P, N, 2) pixels; far outside where `ahead` does not hold
    inverse_depth: Tensor  # (P, N) in b
    ahead: Tensor  # (P, N) bool, before the camera, and of known depth


class PosedFrames:
    """Poses, cameras and inverse depths of frames; the rows are those of the frames in the order of the sequences.

    Args:
        posed: the sequences.
        device: of the depths.
    """

    def __init__(self, posed: Sequence[PosedSequence], device: torch.device) -> None:
        maps = [values for sequence in posed for values in sequence.inverse_depth]
        sizes = [sequence.size for sequence in posed for _ in sequence.inverse_depth]
        scales = [(w / m.shape[1], h / m.shape[0]) for (w, h), m in zip(sizes, maps, strict=True)]
        counts = [len(sequence.pictures) for sequence in posed]
        cameras = [np.broadcast_to(s.K, (n, 3, 3)) for s, n in zip(posed, counts, strict=True)]
        self.depths = DepthStore(maps, np.array(scales).reshape(-1, 2), device)
        self.first = np.cumsum([0, *counts])  # row of each sequence's first frame
        self.K = np.concatenate([np.zeros((0, 3, 3)), *cameras])
        self.world_from_cam = np.concatenate([np.zeros((0, 4, 4)), *(sequence.world_from_cam for sequence in posed)])

    def b_from_a(self, rows: Int64) -> Float64:
        """Motions (P, 4, 4) of pairs of frames (P, 2)."""
        return np.asarray(np.linalg.inv(self.world_from_cam[rows[:, 1]]) @ self.world_from_cam[rows[:, 0]])

    def carry(self, rows: Int64, in_a: Tensor, inverse: Tensor, b_from_a: Float64 | None = None) -> Carried:
        """Places in frames b of places in frames a of given inverse depths, hidden or not.

        Args:
            rows: (P, 2) frames a, b.
            in_a: (P, N, 2) pixels.
            inverse: (P, N); 0 where unknown.
            b_from_a: (P, 4, 4) in place of the frames' own motions.
        """
        motion = self.b_from_a(rows) if b_from_a is None else b_from_a
        turned = self.K[rows[:, 1]] @ motion[:, :3, :3] @ np.linalg.inv(self.K[rows[:, 0]])
        moved = (self.K[rows[:, 1]] @ motion[:, :3, 3:])[..., 0]
        A, t = (on_device(part, in_a.device) for part in (turned, moved))
        seen = torch.cat([in_a, torch.ones_like(in_a[..., :1])], dim=-1)
        seen = (seen[:, :, None] * A[:, None]).sum(dim=-1) + inverse[..., None] * t[:, None]  # over the depth in a
        ahead = (inverse > 0) & (seen[..., 2] > 1e-3)
        depth = torch.where(ahead, seen[..., 2], 1.0)
        places = torch.where(ahead[..., None], seen[..., :2] / depth[..., None], FAR)
        return Carried(places, inverse / depth, ahead)

    def shown(self, rows: Int64, carried: Carried, tolerance: float) -> Tensor:
        """(P, N) whether nothing in frames b hides the places: b has the same depth there.

        Args:
            rows: (P, 2).
            carried: the places.
            tolerance: of the depths, relative.
        """
        found = self.depths.sample(rows[:, 1], carried.places)
        return carried.ahead & ((carried.inverse_depth - found).abs() < tolerance * found)

    def local_warps(self, rows: Int64, in_a: Tensor, inverse: Tensor) -> Tensor:
        """(P, N, 2, 2) how pixels of b follow those of a about each place, by the surface that the depths show."""
        columns = []
        for axis in (0, 1):
            ends = []
            for sign in (-1.0, 1.0):
                step = torch.zeros(2, device=in_a.device)
                step[axis] = sign * _SIDE
                there = in_a + step
                own = self.depths.sample(rows[:, 0], there)
                same = (own - inverse).abs() < _SAME_SURFACE * inverse
                ends.append(self.carry(rows, there, torch.where(same, own, inverse)).places)
            columns.append((ends[1] - ends[0]) / (2 * _SIDE))
        return torch.stack(columns, dim=-1)
