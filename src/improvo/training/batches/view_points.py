"""Points of many views at once, on a device: keypoints of the cells, homographies, and what lies within."""

from __future__ import annotations

import torch
from torch import Tensor

from improvo.frontend.architecture import CELL
from improvo.training.data.point_labels import DUSTBIN
from improvo.training.device import on_device
from improvo.types import Float64

FAR = -1e6  # pixels, in place of a place that no picture shows: behind the camera, or beyond the horizon


def cell_corners(rows: int, columns: int, device: torch.device) -> Tensor:
    """(C, 2) the top left pixels of the cells, row by row."""
    cells = torch.arange(rows * columns, device=device)
    return torch.stack([cells % columns, cells // columns], dim=-1) * float(CELL)


def cell_keypoints(logits: Tensor) -> tuple[Tensor, Tensor]:
    """Best pixel (B, C, 2) of every cell of detector logits (B, 65, rows, columns), and its log-probability (B, C)."""
    scores, best = logits[:, :DUSTBIN].flatten(2).max(dim=1)
    rows, columns = logits.shape[2:]
    corner = cell_corners(rows, columns, logits.device)
    keypoints = corner + torch.stack([best % CELL, best // CELL], dim=-1)
    return keypoints, scores - torch.logsumexp(logits.flatten(2), dim=1)


def warped(H: Float64, points: Tensor) -> Tensor:
    """Pixels (B, N, 2) through homographies (B, 3, 3); far outside at and beyond the horizon.

    Args:
        H: float64, on the host.
        points: on a device, where the result is too.
    """
    matrix = on_device(H, points.device)
    seen = torch.cat([points, torch.ones_like(points[..., :1])], dim=-1)
    seen = (seen[:, :, None] * matrix[:, None]).sum(dim=-1)  # in full precision whatever a product may use
    depth = seen[..., 2:]
    return torch.where(depth > 1e-6, seen[..., :2] / depth.clamp(min=1e-6), FAR)


def within(points: Tensor, sizes: Tensor) -> Tensor:
    """(B, N) whether points (B, N, 2) lie within images of sizes (B, 2) width, height."""
    return ((points >= 0) & (points <= sizes[:, None] - 1)).all(dim=-1)
