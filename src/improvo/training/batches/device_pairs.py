"""Batches of pairs of views made where the network runs: pictures stay in the device's memory, as do their depths."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from improvo.errors import InputError
from improvo.training.augmentation.photometric_batch import augment_batch
from improvo.training.augmentation.views import inside, warp_points
from improvo.training.augmentation.views_batch import random_views
from improvo.training.batches.pair_points import PairPlan, PairPoints
from improvo.training.batches.picture_store import MaskStore, PictureStore
from improvo.training.batches.posed_frames import PosedFrames
from improvo.training.batches.teacher import Teacher
from improvo.training.batches.whole_frames import WholeFrames
from improvo.training.data.pictures import Pictures, Source
from improvo.training.data.posed_sequence import PosedSequence, overlapping_pairs
from improvo.training.device import on_device
from improvo.training.distributed import Process
from improvo.training.held_settings import HeldSettings
from improvo.types import Float64, Int64


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

    Raises:
        InputError: neither pictures nor posed sequences of which two frames overlap.
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
        self.points = PairPoints(self.store, self.frames, self.masks, settings)
        self.first_picture = len(frames) + np.cumsum([0, *(len(source.pictures) for source in pictures.sources)])
        self.pairs = [overlapping_pairs(sequence, settings.pairs) for sequence in posed]
        self.weights = np.array([sequence.weight for sequence in posed])
        self.useful = [row for row, pairs in enumerate(self.pairs) if pairs is not None]
        if not self.sources and not self.useful:
            names = ", ".join(sequence.name for sequence in posed)
            raise InputError(
                f"nothing to train on: no two frames of {names} show enough of the same places; give pictures too, or "
                "recordings of a camera that moves less between frames"
            )
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
        keypoints, points = self.points.related(plan, logits[: len(plan.rows)].float(), generator)
        if settings.pairs.alone:
            points = self.points.with_alone(plan, logits[len(plan.rows) :].float(), keypoints, points)
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

    def _two_whole(self, rng: np.random.Generator, count: int) -> PairPlan:
        """Two frames each of one recording, as they are but for what is beyond the last whole cell."""
        scene = self._scenes(rng, 1)[0]
        pairs = self.pairs[scene]
        assert pairs is not None
        rows = self.frames.first[scene] + np.array([pairs.draw(rng)[:2] for _ in range(count)], np.int64)
        none = np.tile(np.eye(3), (2 * count, 1, 1))
        return PairPlan(
            rows, np.full(count, scene), none[:count], none, count, self.whole_frames.size(rows[0, 0]), whole=True
        )

    def _plan(self, rng: np.random.Generator, count: int) -> PairPlan:
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
        return PairPlan(rows, scenes, b_from_a, np.concatenate([H_a, H_b]), related, (views.width, views.height))

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


def _mask_store(runs: Sequence[PosedSequence | Source], store: PictureStore, device: torch.device) -> MaskStore | None:
    """Of all pictures; None where none has a mask."""
    if not any(run.masks for run in runs):
        return None
    masks = [mask for run in runs for mask in (run.masks or (None,) * len(run.pictures))]
    return MaskStore(masks, store.sizes[: store.count], device)
