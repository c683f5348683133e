"""Batches of pairs of views made where the network runs: pictures stay in the device's memory, as do their depths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from improvo.errors import InputError
from improvo.frontend.architecture import CELL
from improvo.training.alignment import aligned
from improvo.training.distributed import Process
from improvo.training.held_settings import HeldSettings
from improvo.training.photometric_batch import augment_batch
from improvo.training.picture_store import MaskStore, PictureStore, on_device
from improvo.training.pictures import Pictures, Source
from improvo.training.posed import PosedSequence, overlapping_pairs
from improvo.training.posed_frames import Carried, PosedFrames
from improvo.training.random_views import random_views
from improvo.training.teacher import Teacher
from improvo.training.view_points import cell_corners, cell_keypoints, warped, within
from improvo.training.views import inside, warp_points
from improvo.training.whole_frames import WholeFrames
from improvo.types import Float64, Int64

_SPREAD = 1.0  # of the random part of a keypoint's score, beside the logarithm of its probability


@dataclass(frozen=True)
class _Plan:
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


class DevicePairs:
    """Batch number i, always the same for the same seed on the same device: (2B) images, first the a views.

    A batch has `images` (2B, 1, H, W) uint8, `points_a`, `points_b` (B, N, 2) float32 pixels that show the same place,
    `valid` (B, N) bool, `scenes` (B,) int64, `detector` (2B, 65, Hc, Wc) the logits that are held to, with a
    teacher of stability `stability` (2B / every, 2, Hc, Wc), and with frozen layers `stem` (2B, C, h, w), what these
    make of the images.

    Args:
        pictures: homography pairs are made of these, and of the frames of `posed`.
        detector: its logits choose keypoints and are held to.
        stability: likewise, for every `stability_every`-th view.
    """

    def __init__(
        self,
        pictures: Pictures,
        posed: Sequence[PosedSequence],
        settings: HeldSettings,
        detector: Teacher,
        stability: Teacher | None,
        device: torch.device,
    ) -> None:
        if not pictures.sources and not posed:
            raise InputError("nothing to train on: give pictures or posed sequences")
        self.settings, self.device = settings, device
        self.detector, self.stability = detector, stability
        self.sources = pictures.sources
        frames = [picture for sequence in posed for picture in sequence.pictures]
        singles = [picture for source in pictures.sources for picture in source.pictures]
        self.store = PictureStore([*frames, *singles], device)
        self.masks = _mask_store([*posed, *pictures.sources], self.store, device)
        self.frames = PosedFrames(posed, device)
        self.first_picture = len(frames) + np.cumsum([0, *(len(source.pictures) for source in pictures.sources)])
        self.pairs = [overlapping_pairs(sequence, settings.pairs) for sequence in posed]
        self.weights = np.array([sequence.weight for sequence in posed])
        self.useful = [row for row, pairs in enumerate(self.pairs) if pairs is not None]
        self.whole = settings.pairs.whole_frames if settings.pairs.two_frames and self.useful else 0
        self.whole_frames = WholeFrames(self.store, self._taught_of_each, settings.pairs.frames_remembered)
        self.process = Process.current()

    def __len__(self) -> int:
        return self.settings.optimiser.steps

    def __getitem__(self, step: int) -> dict[str, Tensor]:
        with torch.no_grad():
            return self._batch(step)

    def _batch(self, step: int) -> dict[str, Tensor]:
        settings = self.settings
        rng = np.random.default_rng([settings.optimiser.seed, step, self.process.rank])
        generator = torch.Generator(self.device).manual_seed(int(rng.integers(2**62)))
        if self.whole:
            plan = self._two_whole(rng, len(self.process.part_of(self.whole)))
        else:
            plan = self._plan(rng, len(self.process.part_of(settings.optimiser.batch_size)))
        if plan.whole:
            batch = self.whole_frames.batch(plan.rows.T.ravel())
            if "stability" in batch:
                batch["stability"] = batch["stability"][:: settings.stability_every]
        else:
            shown = self.store.views(plan.rows.T.ravel(), plan.view_from_picture, *plan.size)
            images = augment_batch(shown, rng, generator, settings.photometric)
            batch = {"images": images, **self.taught(images)}
        batch["scenes"] = on_device(plan.scenes, self.device)
        logits = batch["detector"]
        points = self._points(plan, logits[: len(plan.rows)].float(), generator)
        if settings.pairs.alone:
            points = self._with_alone(plan, logits.float(), points)
        return {**batch, **points}

    def _taught_of_each(self, images: Tensor) -> dict[str, Tensor]:
        return self.taught(images, every=1)

    def taught(self, images: Tensor, every: int = 0) -> dict[str, Tensor]:
        """What the teachers say of views (V, 1, H, W) uint8: `detector` and, with a teacher of it, `stability`.

        Args:
            every: so many views for one that the teacher of stability looks at; 0 for what the settings say.
        """
        network_input = (images.float() / 255).contiguous(memory_format=torch.channels_last)
        frozen = self.settings.frozen_layers
        logits, stem = self.detector(network_input, frozen)
        said = {"detector": logits, **({"stem": stem} if frozen else {})}
        if self.stability is not None and not self.settings.holds_by_itself:
            said["stability"] = self.stability(network_input[:: every or self.settings.stability_every])[0]
        return said

    def _two_whole(self, rng: np.random.Generator, count: int) -> _Plan:
        """Two frames each of one recording, as they are but for what is beyond the last whole cell."""
        scene = self._scenes(rng, 1)[0]
        pairs = self.pairs[scene]
        assert pairs is not None
        rows = self.frames.first[scene] + np.array([pairs.draw(rng)[:2] for _ in range(count)], np.int64)
        none = np.tile(np.eye(3), (2 * count, 1, 1))
        return _Plan(
            rows, np.full(count, scene), none[:count], none, count, self.whole_frames.size(rows[0, 0]), whole=True
        )

    def _plan(self, rng: np.random.Generator, count: int) -> _Plan:
        """Which pictures are seen, and from where."""
        settings, views = self.settings.pairs, self.settings.views
        share = settings.posed_share if self.sources else 1.0
        posed = round(share * count) if self.useful else 0
        rows, scenes = np.zeros((count, 2), np.int64), np.zeros(count, np.int64)
        b_from_a = np.tile(np.eye(3), (count, 1, 1))
        centres = np.full((2, count, 2), np.nan)
        order = self._scenes(rng, posed)
        for pair in range(count):
            if pair < posed:
                scene = scenes[pair] = order[pair]
                pairs = self.pairs[scene]
                assert pairs is not None
                a, b, centres[0, pair], centres[1, pair] = pairs.draw(rng)
                rows[pair] = self.frames.first[scene] + np.array([a, b if settings.two_frames else a])
            else:
                source, a, b, b_from_a[pair] = self._picture_pair(rng)
                scenes[pair] = len(self.pairs) + source
                rows[pair] = self.first_picture[source] + np.array([a, b])
        related = posed if settings.two_frames else 0
        sizes = self.store.sizes[rows].astype(np.float64)
        H_a = random_views(rng, views, sizes[:, 0], centres[0])
        self._look_there(H_a, b_from_a, rows, sizes, centres[1], related)
        H_b = random_views(rng, views, sizes[:, 1], centres[1])
        return _Plan(rows, scenes, b_from_a, np.concatenate([H_a, H_b]), related, (views.width, views.height))

    def _scenes(self, rng: np.random.Generator, count: int) -> list[int]:
        """Which sequences the pairs are of: every one once before any comes again, or, of different weights, drawn."""
        weights = self.weights[self.useful]
        if count and (weights != weights[0]).any():
            return [int(scene) for scene in rng.choice(self.useful, count, p=weights / weights.sum())]
        turns = -(-count // max(len(self.useful), 1))
        return [int(scene) for _ in range(turns) for scene in rng.permutation(self.useful)]

    def _picture_pair(self, rng: np.random.Generator) -> tuple[int, int, int, Float64]:
        """Source, two of its pictures, and the homography between them; mostly one picture twice."""
        chosen, a = Pictures(self.sources).draw(rng)
        source, b = self.sources[chosen], a
        if source.rotating is not None and rng.uniform() < 0.5:
            b = int(np.clip(a + rng.integers(-8, 9), 0, len(source.pictures) - 1))
        return chosen, a, b, source.homography(a, b)

    def _look_there(
        self, H_a: Float64, b_from_a: Float64, rows: Int64, sizes: Float64, centres: Float64, related: int
    ) -> None:
        """Let view b of a homography pair look where view a does; a picture that does not show it is replaced by a."""
        views = self.settings.views
        middle = np.array([(views.width - 1) / 2, (views.height - 1) / 2])
        for pair in range(related, len(rows)):
            here = warp_points(np.linalg.inv(H_a[pair]), middle)
            there = warp_points(b_from_a[pair], here)
            if not inside(there, *sizes[pair, 1]):
                there, rows[pair, 1], b_from_a[pair] = here, rows[pair, 0], np.eye(3)
                sizes[pair, 1] = sizes[pair, 0]
            centres[pair] = there

    def _points(self, plan: _Plan, logits: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
        """Keypoints of view a and other points, one candidate of either kind a cell, as far as view b shows them."""
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
        carried, visible = self._carry(plan, candidates)
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
        return {"points_a": points_a, "points_b": points_b, "valid": valid}

    def _with_alone(self, plan: _Plan, logits: Tensor, points: dict[str, Tensor]) -> dict[str, Tensor]:
        """More rows, which are no correspondences: the best keypoints of either view that the other one does not show.

        They are wrong partners of the others, as in use, where most keypoints of distant frames have no partner.
        """
        count = len(plan.rows)
        a_from_b = np.asarray(np.linalg.inv(plan.b_from_a))
        views = np.roll(plan.view_from_picture, count, axis=0)
        turned = replace(plan, rows=plan.rows[:, ::-1], b_from_a=a_from_b, view_from_picture=views)
        most = min(self.settings.pairs.alone, logits.shape[2] * logits.shape[3])
        found, known = [], []
        for one, seen in ((plan, logits[:count]), (turned, logits[count:])):
            keypoints, scores = cell_keypoints(seen)
            absent = self._absent(one, keypoints)
            rank, best = scores.masked_fill(~absent, -torch.inf).topk(most, dim=1)
            found.append(keypoints.gather(1, best[..., None].expand(-1, -1, 2)))
            known.append(rank.isfinite())
        invalid = torch.zeros_like(known[0])
        return {
            "points_a": torch.cat([points["points_a"], found[0]], dim=1),
            "points_b": torch.cat([points["points_b"], found[1]], dim=1),
            "valid": torch.cat([points["valid"], invalid], dim=1),
            "negative": torch.cat([points["valid"], known[0]], dim=1),
            "negative_b": torch.cat([points["valid"], known[1]], dim=1),
        }

    def _carry(self, plan: _Plan, points: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels of view b (B, N, 2) of pixels of view a, and whether both pictures show the place."""
        in_a, in_b, posed = self._in_pictures(plan, points)
        sizes = on_device(self.store.sizes[plan.rows].astype(np.float32), points.device)
        visible = within(in_a, sizes[:, 0]) & within(in_b, sizes[:, 1])
        if posed is not None:
            shown = self.frames.shown(plan.rows[: plan.posed], posed.carried, self.settings.pairs.depth_tolerance)
            visible[: plan.posed] &= shown
        if self.masks is not None:
            visible = visible & self.masks.used(plan.rows[:, 0], in_a) & self.masks.used(plan.rows[:, 1], in_b)
        result = warped(plan.view_from_picture[len(plan.rows) :], torch.where(visible[..., None], in_b, 0.0))
        return result, visible & within(result, on_device(np.array([plan.size], np.float32), points.device))

    def _absent(self, plan: _Plan, points: Tensor) -> Tensor:
        """Of pixels of view a (B, N, 2), whether it is certain that view b does not show the place."""
        in_a, in_b, posed = self._in_pictures(plan, points)
        sizes = on_device(self.store.sizes[plan.rows].astype(np.float32), points.device)
        known = within(in_a, sizes[:, 0])
        if posed is not None:
            known[: plan.posed] &= posed.inverse_depth > 0
        if self.masks is not None:
            known = known & self.masks.used(plan.rows[:, 0], in_a)
        there = warped(plan.view_from_picture[len(plan.rows) :], in_b)
        size = on_device(np.array([plan.size], np.float32), there.device)
        margin = self.settings.masked_pixels
        return known & ~within(there + margin, size + 2 * margin)

    def _in_pictures(self, plan: _Plan, points: Tensor) -> tuple[Tensor, Tensor, _ByDepth | None]:
        """Pixels of view a in picture a and in picture b (B, N, 2), and what depth says of those of posed pairs."""
        in_a = warped(np.asarray(np.linalg.inv(plan.view_from_picture[: len(plan.rows)])), points)
        in_b = warped(plan.b_from_a, in_a)
        if not plan.posed:
            return in_a, in_b, None
        rows = plan.rows[: plan.posed]
        inverse = self.frames.depths.sample(rows[:, 0], in_a[: plan.posed])
        carried = self.frames.carry(rows, in_a[: plan.posed], inverse)
        in_b[: plan.posed] = carried.places
        return in_a, in_b, _ByDepth(inverse, carried)

    def _by_pictures(self, plan: _Plan, points_a: Tensor, points_b: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
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


def _mask_store(runs: Sequence[PosedSequence | Source], store: PictureStore, device: torch.device) -> MaskStore | None:
    """Of all pictures; None where none has a mask."""
    if not any(run.masks for run in runs):
        return None
    masks = [mask for run in runs for mask in (run.masks or (None,) * len(run.pictures))]
    return MaskStore(masks, store.sizes[: store.count], device)
