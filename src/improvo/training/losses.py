"""The losses of the training stages, in torch."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from improvo.training.labels import DUSTBIN, IGNORED
from improvo.training.settings import DetectorLossSettings


def detector_loss(logits: Tensor, cells: Tensor, settings: DetectorLossSettings | None = None) -> Tensor:
    """Softmax cross-entropy over the 65 classes of a cell; ignored cells count for nothing (paper, "Training Details").

    Most cells have no keypoint, so this alone teaches for a long time only whether there is one. The position term,
    which SuperPoint does not have, is the cross-entropy over the 64 pixels of the cells that have one, against a small
    Gaussian about the keypoint.

    Args:
        logits: (B, 65, Hc, Wc).
        cells: (B, Hc, Wc) int64, 0..64 or `IGNORED`.
        settings: of the position term; without it this is SuperPoint's loss.
    """
    logits = logits.float()
    total = functional.cross_entropy(logits, cells, ignore_index=IGNORED, reduction="sum")
    loss = total / (cells != IGNORED).sum().clamp(min=1)
    if settings is None or not settings.position_weight:
        return loss
    taught = (cells >= 0) & (cells < DUSTBIN)
    pixels = logits[:, :DUSTBIN].permute(0, 2, 3, 1)[taught]
    targets = _gaussians(settings.position_sigma).to(pixels)[cells[taught]]
    position = functional.cross_entropy(pixels, targets, reduction="sum") / taught.sum().clamp(min=1)
    return loss + settings.position_weight * position


def _gaussians(sigma: float) -> Tensor:
    """(64, 64) row k: weights of a cell's pixels for a keypoint at its pixel k, which add up to 1."""
    side = torch.arange(8.0)
    y, x = torch.meshgrid(side, side, indexing="ij")
    places = torch.stack([x.flatten(), y.flatten()], dim=1)
    return functional.softmax(-(torch.cdist(places, places) ** 2) / (2 * sigma**2), dim=1)


def info_nce_loss(
    a: Tensor,
    b: Tensor,
    points_a: Tensor,
    points_b: Tensor,
    valid: Tensor,
    scale: Tensor,
    masked_pixels: float,
    negative: Tensor | None = None,
    group: int = 1,
    scenes: Tensor | None = None,
) -> Tensor:
    """Symmetric InfoNCE over sparse correspondences: each descriptor must pick its partner among those of its pair.

    Args:
        a, b: (B, N, D) unit descriptors of corresponding points.
        points_a, points_b: (B, N, 2) pixels; points nearer than `masked_pixels` in either view are not negatives.
        valid: (B, N) bool.
        scale: () inverse temperature.
        negative: (B, N) bool, which rows may be wrong partners of others; the valid ones where it is not given.
        group: so many consecutive pairs have their points for each other's negatives too; B must be a multiple.
        scenes: (B,) int; pairs of the same scene, which may show the same places, are not each other's negatives.
    """
    negative = valid if negative is None else negative
    # not by matrix products, which may run in low precision
    near = _near(points_a, masked_pixels) | _near(points_b, masked_pixels)
    if group > 1:  # large pairs, in which only points of the same view can be near each other
        near = _grouped(near, group, scenes)
        a, b = (part.reshape(-1, group * part.shape[1], part.shape[2]) for part in (a, b))
        valid, negative = (part.reshape(-1, group * part.shape[1]) for part in (valid, negative))
    refused = near | ~negative[:, None, :] | ~negative[:, :, None]
    itself = torch.eye(a.shape[1], dtype=torch.bool, device=a.device)
    similarity = (scale * torch.einsum("bnd,bmd->bnm", a, b)).masked_fill(refused & ~itself, -1e4)
    forward = torch.logsumexp(similarity, dim=2)
    backward = torch.logsumexp(similarity, dim=1)
    right = torch.diagonal(similarity, dim1=1, dim2=2)
    loss = 0.5 * (forward + backward) - right
    return (loss * valid).sum() / valid.sum().clamp(min=1)


def _grouped(near: Tensor, group: int, scenes: Tensor | None) -> Tensor:
    """(B / group, group·N, group·N) what may not be told apart, from that of each pair (B, N, N)."""
    pairs, points, _ = near.shape
    alike = torch.zeros(pairs // group, group, group, dtype=torch.bool, device=near.device)
    if scenes is not None:
        within = scenes.view(-1, group)
        alike = within[:, :, None] == within[:, None, :]
    refused = alike[:, :, None, :, None].repeat(1, 1, points, 1, points)
    for row in range(group):
        refused[:, row, :, row] = near.view(-1, group, points, points)[:, row]
    return refused.view(-1, group * points, group * points)


def held_loss(logits: Tensor, teacher: Tensor) -> Tensor:
    """Divergence (Kullback-Leibler) of the softmax over channels from the teacher's, mean over cells.

    Args:
        logits, teacher: (B, C, Hc, Wc).
    """
    wanted = functional.log_softmax(teacher.float(), dim=1)
    given = functional.log_softmax(logits.float(), dim=1)
    return (wanted.exp() * (wanted - given)).sum(dim=1).mean()


def hinge_loss(
    a: Tensor,
    b: Tensor,
    points_b: Tensor,
    centres: Tensor,
    valid: Tensor,
    positive_margin: float = 1.0,
    negative_margin: float = 0.2,
    positive_weight: float = 250.0,
) -> Tensor:
    """SuperPoint's dense hinge loss between all cells of two views (its equations 4 to 6).

    Args:
        a, b: (B, N, D) unit descriptors of all cells of either view.
        points_b: (B, N, 2) where the centres of the cells of view a lie in view b.
        centres: (N, 2) centres of the cells; a pair of cells corresponds within 8 pixels.
        valid: (B, N) bool, cells of view a that view b shows.
    """
    similarity = torch.einsum("bnd,bmd->bnm", a, b)
    same = (torch.cdist(points_b, centres.expand(len(a), -1, -1)) <= 8) & valid[:, :, None]
    positive = positive_weight * (positive_margin - similarity).clamp(min=0)
    negative = (similarity - negative_margin).clamp(min=0)
    return (torch.where(same, positive, negative) * valid[:, :, None]).sum() / (valid.sum().clamp(min=1) * b.shape[1])


def stability_loss(logits: Tensor, stability: Tensor, stable_per_unstable: float) -> Tensor:
    """Binary cross-entropy, balanced: over all labels, stable and unstable points weigh the same.

    The balance is that of the whole label set, not of the batch: in a batch with one unstable point that one would
    weigh as much as all others together, and such lone points are the wrong labels more often than others.

    Args:
        logits: (B, N, 2) at labelled points; channel 1 is "stable".
        stability: (B, N) int64, 1 stable, 0 unstable, `IGNORED`.
        stable_per_unstable: how many labels of one kind there are for one of the other.
    """
    errors = functional.cross_entropy(logits.transpose(1, 2), stability, ignore_index=IGNORED, reduction="none")
    stable, unstable = ((errors * (stability == code)).sum() for code in (1, 0))
    return 0.5 * (stable + stable_per_unstable * unstable) / (stability == 1).sum().clamp(min=1)


def _near(points: Tensor, radius: float) -> Tensor:
    """(B, N, N) whether two points (B, N, 2) of a view are nearer than a radius; not by `cdist`, slow on a GPU."""
    x, y = points[..., 0], points[..., 1]
    return (x[:, :, None] - x[:, None]) ** 2 + (y[:, :, None] - y[:, None]) ** 2 < radius**2
