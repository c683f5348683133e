"""Which pixels of two views show the same place: keypoints that both show, and keypoints that the other does not."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from improvo.frontend.architecture import CELL
from improvo.training.batches.alignment import aligned
from improvo.training.batches.picture_store import MaskStore, PictureStore
from improvo.training.batches.posed_frames import Carried, PosedFrames
from improvo.training.batches.view_points import cell_corners, cell_keypoints, warped, within
from improvo.training.device import on_device
from improvo.training.held_settings import HeldSettings
from improvo.types import Float64, Int64

_SPREAD = 1.0  # of the random part of a keypoint's score, beside the logarithm of its probability


@dataclass(frozen=True)
class PairPlan:
    """The pairs of one batch: pictures, homographies between them where depth does not relate them, and views."""

    rows: Int64  # (B, 2) pictures a, b of the store
    scenes: Int64  # (B,) pairs of one scene may show the same places
    b_from_a: Float64  # (B, 3, 3) between the pictures; of no use for the first `posed` pairs
    view_from_picture: Float64  # (2B, 3, 3), first the a views
    posed: int  # so many pairs, the first ones, are related by depth and poses
    size: tuple[int, int]  # width, height of the views
    whole: bool = False  # the views are the frames as they are


class _ByDepth(NamedTuple):
    """Points of the posed pairs."""

    inverse_depth: Tensor  # (P, N) in picture a, 0 where unknown
    carried: Carried  # to picture b

    def first(self, count: int) -> _ByDepth:
        """The first `count` points of each pair."""
        return _ByDepth(self.inverse_depth[:, :count], Carried(*(part[:, :count] for part in self.carried)))


class _InPictures(NamedTuple):
    """Pixels of view a in the pictures of their pair."""

    in_a: Tensor  # (B, N, 2)
    in_b: Tensor  # (B, N, 2)
    posed: _ByDepth | None  # what depth says of those of posed pairs

    def first(self, count: int) -> _InPictures:
        """The first `count` points of each pair."""
        posed = None if self.posed is None else self.posed.first(count)
        return _InPictures(self.in_a[:, :count], self.in_b[:, :count], posed)


class Keypoints(NamedTuple):
    """The best pixel of every cell of view a."""

    places: Tensor  # (B, C, 2)
    scores: Tensor  # (B, C) log-probabilities
    pictures: _InPictures


class PairPoints:
    """Points of the pairs of a batch.

    Args:
        store: the pictures.
        frames: those of them that depth and poses relate, the first ones.
        masks: of the pictures, if there are any.
        settings: how many points of which kind.
    """

    def __init__(
        self, store: PictureStore, frames: PosedFrames, masks: MaskStore | None, settings: HeldSettings
    ) -> None:
        self.store, self.frames, self.masks, self.settings = store, frames, masks, settings

    def related(
        self, plan: PairPlan, logits: Tensor, generator: torch.Generator
    ) -> tuple[Keypoints, dict[str, Tensor]]:
        """Keypoints of view a, and of them and other points, one of either kind a cell, those that view b shows."""
        settings = self.settings.pairs
        pairs, _, rows, columns = logits.shape
        keypoints, scores = cell_keypoints(logits)
        corner = cell_corners(rows, columns, logits.device)
        shape = (pairs, rows * columns, 2)
        others = corner + CELL * torch.rand(shape, generator=generator, device=logits.device) - 0.5
        noise = -torch.log(
            -torch.log(torch.rand(shape, generator=generator, device=logits.device).clamp(1e-9, 1 - 1e-6))
        )
        candidates = torch.cat([keypoints, others], dim=1)
        pictures = self._in_pictures(plan, candidates)
        carried, visible = self._carry(plan, pictures)
        points = settings.whole_points if plan.whole else settings.points
        wanted = round(points * settings.keypoint_share)
        kept = min(wanted, rows * columns), min(points - wanted, rows * columns)
        rank = torch.cat([scores + _SPREAD * noise[..., 0], noise[..., 1]], dim=1).masked_fill(~visible, -torch.inf)
        halves = rank.split(rows * columns, dim=1)
        chosen = torch.cat(
            [halves[0].topk(kept[0], dim=1)[1], halves[1].topk(kept[1], dim=1)[1] + rows * columns], dim=1
        )
        valid = visible.gather(1, chosen)
        where = chosen[..., None].expand(-1, -1, 2)
        points_a = candidates.gather(1, where)
        points_b = torch.where(valid[..., None], carried.gather(1, where), 0.0)
        if settings.aligned and plan.posed:
            points_b, valid = self._by_pictures(plan, points_a, points_b, valid)
        found = Keypoints(keypoints, scores, pictures.first(rows * columns))
        return found, {"points_a": points_a, "points_b": points_b, "valid": valid}

    def with_alone(
        self, plan: PairPlan, logits_b: Tensor, of_a: Keypoints, points: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        """More rows, which are no correspondences: the best keypoints of either view that the other one does not show.

        They are wrong partners of the others, as in use, where most keypoints of distant frames have no partner.
        """
        count = len(plan.rows)
        a_from_b = np.asarray(np.linalg.inv(plan.b_from_a))
        views = np.roll(plan.view_from_picture, count, axis=0)
        turned = replace(plan, rows=plan.rows[:, ::-1], b_from_a=a_from_b, view_from_picture=views)
        keypoints, scores = cell_keypoints(logits_b)
        of_b = Keypoints(keypoints, scores, self._in_pictures(turned, keypoints))
        most = min(self.settings.pairs.alone, scores.shape[1])
        found, known = [], []
        for one, seen in ((plan, of_a), (turned, of_b)):
            absent = self._absent(one, seen.pictures)
            rank, best = seen.scores.masked_fill(~absent, -torch.inf).topk(most, dim=1)
            found.append(seen.places.gather(1, best[..., None].expand(-1, -1, 2)))
            known.append(rank.isfinite())
        invalid = torch.zeros_like(known[0])
        return {
            "points_a": torch.cat([points["points_a"], found[0]], dim=1),
            "points_b": torch.cat([points["points_b"], found[1]], dim=1),
            "valid": torch.cat([points["valid"], invalid], dim=1),
            "negative": torch.cat([points["valid"], known[0]], dim=1),
            "negative_b": torch.cat([points["valid"], known[1]], dim=1),
        }

    def _carry(self, plan: PairPlan, pictures: _InPictures) -> tuple[Tensor, Tensor]:
        """Pixels of view b (B, N, 2) of pixels of view a, and whether both pictures show the place."""
        in_a, in_b, posed = pictures
        sizes = on_device(self.store.sizes[plan.rows].astype(np.float32), in_a.device)
        visible = within(in_a, sizes[:, 0]) & within(in_b, sizes[:, 1])
        if posed is not None:
            shown = self.frames.shown(plan.rows[: plan.posed], posed.carried, self.settings.pairs.depth_tolerance)
            visible[: plan.posed] &= shown
        if self.masks is not None:
            visible = visible & self.masks.used(plan.rows[:, 0], in_a) & self.masks.used(plan.rows[:, 1], in_b)
        result = warped(plan.view_from_picture[len(plan.rows) :], torch.where(visible[..., None], in_b, 0.0))
        return result, visible & within(result, on_device(np.array([plan.size], np.float32), in_a.device))

    def _absent(self, plan: PairPlan, pictures: _InPictures) -> Tensor:
        """Of pixels of view a (B, N, 2), whether it is certain that view b does not show the place."""
        in_a, in_b, posed = pictures
        sizes = on_device(self.store.sizes[plan.rows].astype(np.float32), in_a.device)
        known = within(in_a, sizes[:, 0])
        if posed is not None:
            known[: plan.posed] &= posed.inverse_depth > 0
        if self.masks is not None:
            known = known & self.masks.used(plan.rows[:, 0], in_a)
        there = warped(plan.view_from_picture[len(plan.rows) :], in_b)
        size = on_device(np.array([plan.size], np.float32), there.device)
        margin = self.settings.masked_pixels
        absent = ~within(there + margin, size + 2 * margin)
        if posed is not None:
            absent[: plan.posed] |= ~posed.carried.ahead  # behind the camera, wherever a homography takes that
        return known & absent

    def _in_pictures(self, plan: PairPlan, points: Tensor) -> _InPictures:
        """Where pixels of view a (B, N, 2) are in the pictures."""
        in_a = warped(np.asarray(np.linalg.inv(plan.view_from_picture[: len(plan.rows)])), points)
        in_b = warped(plan.b_from_a, in_a)
        if not plan.posed:
            return _InPictures(in_a, in_b, None)
        rows = plan.rows[: plan.posed]
        inverse = self.frames.depths.sample(rows[:, 0], in_a[: plan.posed])
        carried = self.frames.carry(rows, in_a[: plan.posed], inverse)
        in_b[: plan.posed] = carried.places
        return _InPictures(in_a, in_b, _ByDepth(inverse, carried))

    def _by_pictures(self, plan: PairPlan, points_a: Tensor, points_b: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
        """Partners (B, N, 2) of pixels of the a views, and which are known: by depth, and as the pictures have them."""
        posed = plan.posed
        rows = plan.rows[:posed]
        in_a = warped(np.asarray(np.linalg.inv(plan.view_from_picture[:posed])), points_a[:posed])
        inverse = torch.where(valid[:posed], self.frames.depths.sample(rows[:, 0], in_a), 0.0)
        found = aligned(self.store, self.frames, rows, in_a, inverse, self.settings.pairs.align)
        kept = valid[:posed] & ~found.contradicted
        moved = warped(plan.view_from_picture[len(valid) : len(valid) + posed], found.places)
        size = on_device(np.array([plan.size], np.float32), moved.device)
        kept = kept & within(moved, size)
        points_b = torch.cat([torch.where(kept[..., None], moved, 0.0), points_b[posed:]])
        return points_b, torch.cat([kept, valid[posed:]])
