"""The losses of the training stages, in torch."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from improvo.frontend.architecture import CELL
from improvo.training.data.point_labels import DUSTBIN, IGNORED
from improvo.training.settings import DetectorLossSettings
from improvo.training.shared_statistics import share_of_count


def detector_loss(logits: Tensor, cells: Tensor, settings: DetectorLossSettings | None = None) -> Tensor:
    """Mean softmax cross-entropy over the 65 classes of all cells but the ignored ones (paper, "Training Details").

    Most cells have no keypoint. For a long time this alone teaches only whether there is one. The position term, which
    SuperPoint does not have, is the cross-entropy over the 64 pixels of the cells that have a keypoint, against a
    Gaussian about it.

    Args:
        logits: (B, 65, Hc, Wc).
        cells: (B, Hc, Wc) int64, 0..64 or `IGNORED`.
        settings: of the position term; without it this is SuperPoint's loss.
    """
    logits = logits.float()
    total = functional.cross_entropy(logits, cells, ignore_index=IGNORED, reduction="sum")
    loss = total / share_of_count((cells != IGNORED).sum())
    if settings is None or not settings.position_weight:
        return loss
    taught = (cells >= 0) & (cells < DUSTBIN)
    pixels = logits[:, :DUSTBIN].permute(0, 2, 3, 1)[taught]
    targets = _gaussians(settings.position_sigma).to(pixels)[cells[taught]]
    position = functional.cross_entropy(pixels, targets, reduction="sum") / share_of_count(taught.sum())
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
    negative_b: Tensor | None = None,
) -> Tensor:
    """Symmetric InfoNCE over sparse correspondences: each descriptor must pick its partner among those of its pair.

    Args:
        a: (B, N, D) unit descriptors of view a.
        b: (B, N, D) unit descriptors of view b; row n of both is one correspondence.
        points_a: (B, N, 2) pixels of view a.
        points_b: (B, N, 2) pixels of view b.
        valid: (B, N) bool, rows that are a correspondence.
        scale: () inverse temperature.
        masked_pixels: points nearer than this in either view are not each other's negatives.
        negative: (B, N) bool, which rows may be wrong partners of others; the valid ones where it is not given.
        group: so many consecutive pairs have their points for each other's negatives too; B must be a multiple.
        scenes: (B,) int; pairs of the same scene, which may show the same places, are not each other's negatives.
        negative_b: (B, N) bool, as `negative` for the b parts of the rows, where these differ.
    """
    negative = valid if negative is None else negative
    negative_b = negative if negative_b is None else negative_b
    # not by matrix products, which may run in low precision
    near = _near(points_a, masked_pixels) | _near(points_b, masked_pixels)
    if group > 1:  # large pairs, in which only points of the same view can be near each other
        near = _grouped(near, group, scenes)
        a, b = (part.reshape(-1, group * part.shape[1], part.shape[2]) for part in (a, b))
        valid, negative, negative_b = (
            part.reshape(-1, group * part.shape[1]) for part in (valid, negative, negative_b)
        )
    refused = near | ~negative_b[:, None, :] | ~negative[:, :, None]
    itself = torch.eye(a.shape[1], dtype=torch.bool, device=a.device)
    similarity = (scale * torch.einsum("bnd,bmd->bnm", a, b)).masked_fill(refused & ~itself, -1e4)
    forward = torch.logsumexp(similarity, dim=2)
    backward = torch.logsumexp(similarity, dim=1)
    right = torch.diagonal(similarity, dim1=1, dim2=2)
    loss = 0.5 * (forward + backward) - right
    return (loss * valid).sum() / share_of_count(valid.sum())


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
        logits: (B, C, Hc, Wc) of the network.
        teacher: (B, C, Hc, Wc) of the network that it is held to.
    """
    wanted = functional.log_softmax(teacher.float(), dim=1)
    given = functional.log_softmax(logits.float(), dim=1)
    return (wanted.exp() * (wanted - given)).sum(dim=1).mean()


def hinge_loss(
    a: Tensor,
    b: Tensor,
    points_b: Tensor,
    places_b: Tensor,
    valid: Tensor,
    known_b: Tensor | None = None,
    positive_margin: float = 1.0,
    negative_margin: float = 0.2,
    positive_weight: float = 250.0,
) -> Tensor:
    """SuperPoint's hinge loss between all descriptors of two views (its equations 4 to 6).

    SuperPoint compares all cells of both views. Where only some points are known, what is unknown is ignored.

    Args:
        a: (B, N, D) unit descriptors of view a.
        b: (B, M, D) unit descriptors of view b.
        points_b: (B, N, 2) pixels of view b that show what the points of view a show.
        places_b: (B, M, 2) pixels that the descriptors of view b are of; within 8 pixels of each other two correspond.
        valid: (B, N) bool, rows of view a whose place in view b is known.
        known_b: (B, M) bool, descriptors of view b that may be compared with; None for all.
        positive_margin: corresponding descriptors are pulled up to this similarity.
        negative_margin: others are pushed down to this similarity.
        positive_weight: of the former, of which there are few.
    """
    similarity = torch.einsum("bnd,bmd->bnm", a, b)
    compared = valid[:, :, None].expand_as(similarity)
    if known_b is not None:
        compared = compared & known_b[:, None, :]
    same = torch.cdist(points_b, places_b) <= CELL
    positive = positive_weight * (positive_margin - similarity).clamp(min=0)
    negative = (similarity - negative_margin).clamp(min=0)
    return (torch.where(same, positive, negative) * compared).sum() / share_of_count(compared.sum())


def stability_loss(logits: Tensor, stability: Tensor, stable_per_unstable: float | None = None) -> Tensor:
    """Binary cross-entropy at labeled points: the paper's, or balanced.

    Balanced means that over all labels stable and unstable points weigh the same. The balance is that of the whole
    label set, not of the batch. In a batch with one unstable point that one would weigh as much as all others together,
    and such lone points are the wrong labels more often than others.

    Args:
        logits: (B, N, 2) at labeled points; channel 1 is "stable".
        stability: (B, N) int64, 1 stable, 0 unstable, `IGNORED`.
        stable_per_unstable: how many labels of one kind there are for one of the other; None does not balance, so every
            labeled point weighs the same.
    """
    errors = functional.cross_entropy(logits.transpose(1, 2), stability, ignore_index=IGNORED, reduction="none")
    if stable_per_unstable is None:
        return errors.sum() / share_of_count((stability != IGNORED).sum())
    stable, unstable = ((errors * (stability == code)).sum() for code in (1, 0))
    return 0.5 * (stable + stable_per_unstable * unstable) / share_of_count((stability == 1).sum())


def _near(points: Tensor, radius: float) -> Tensor:
    """(B, N, N) whether two points (B, N, 2) of a view are nearer than a radius; not by `cdist`, slow on a GPU."""
    x, y = points[..., 0], points[..., 1]
    return (x[:, :, None] - x[:, None]) ** 2 + (y[:, :, None] - y[:, None]) ** 2 < radius**2
