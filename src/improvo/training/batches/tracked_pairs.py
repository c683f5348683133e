"""Pairs of frames with what the odometry knows of them: the batches of VO adaptation (paper, Siamese training)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from improvo.frontend.masking import unmasked
from improvo.stability.rule import STABLE, UNSTABLE
from improvo.training.augmentation.photometric import augment
from improvo.training.augmentation.views import inside, random_view, warp_image, warp_points
from improvo.training.batches.homography_pairs import PairBatches, View
from improvo.training.batches.seeded import Batch, SeededBatches
from improvo.training.data.label_library import LabelLibrary
from improvo.training.data.labeled_frames import FramePoints, LabeledFrames, common_points
from improvo.training.data.point_labels import DUSTBIN, IGNORED, label_cells
from improvo.training.settings import AdaptationSettings, OdometryTrainingSettings
from improvo.types import Float32, Float64, Int64, UInt8

_CERTAIN, _UNDECIDED = 1.0, 0.2  # agreement of labels as `label_cells` takes it, on either side of `accepted`


@dataclass(frozen=True)
class TrackedView:
    """A frame through a homography and another light, with its points in the view's pixels."""

    image: UInt8  # (H, W)
    cells: Int64  # (Hc, Wc) see `label_cells`
    known: FramePoints  # of the frame; `points` in pixels of the view, NaN or outside where not visible
    view_from_frame: Float64  # (3, 3)
    used: NDArray[np.bool_] | None = None  # (H, W) what shows the frame and is not masked; None without a mask


@dataclass(frozen=True)
class Correspondences:
    """What the descriptor is taught on a pair; a row is a place in view a and one in view b."""

    a: Float32  # (N, 2) pixels
    b: Float32  # (N, 2)
    valid: NDArray[np.bool_]  # (N,) both show the same point
    negative: NDArray[np.bool_]  # (N,) the row may be a wrong partner of others: valid ones, and keypoints without any


class TrackedPairs(SeededBatches):
    """Batches of (2B) images, first the a views, then the b views.

    A batch has `images` (2B, 1, H, W) uint8, `cells` (2B, Hc, Wc) int64, `points_a`, `points_b` (B, N, 2) float32,
    `valid`, `negative` (B, N) bool, `stability_points` (2B, M, 2) float32 and `stability` (2B, M) int64: 1 stable,
    0 unstable, IGNORED.

    Args:
        sequences: labeled video, in memory or opened when drawn.
        settings: of the stage.
        replay: homography pairs of other pictures, which keep the network general; `pairs.replay_share` of all.
    """

    def __init__(
        self,
        sequences: Sequence[LabeledFrames],
        settings: OdometryTrainingSettings,
        replay: PairBatches | None = None,
    ) -> None:
        super().__init__(settings)
        self.sequences, self.settings, self.replay = sequences, settings, replay
        if isinstance(sequences, LabelLibrary):
            self._summaries = sequences.summaries
        else:
            self._summaries = [frames.summary() for frames in sequences]
        self._least = max(settings.pairs.least_points, 1)
        useful = [len(summary.useful_frames(self._least)) for summary in self._summaries]
        self.useful_frames = sum(useful)
        # as with pictures: long recordings leave room for short ones
        self._cumulative = np.cumsum(np.sqrt(useful))
        stable, unstable = (sum(getattr(s, kind) for s in self._summaries) for kind in ("stable", "unstable"))
        self.stable_per_unstable = float(stable / max(unstable, 1))

    def __getitem__(self, step: int) -> Batch:
        optimiser, own = self.settings.optimiser, self.numbers
        pairs = [self._pair(rng) for rng in self.generators(step)]
        views = [pair[0] for pair in pairs] + [pair[1] for pair in pairs]
        numbers = [*own, *(optimiser.batch_size + number for number in own)]  # of the views of the whole batch
        taught = [
            self._stability(np.random.default_rng([optimiser.seed, step, number, 1]), view)
            for number, view in zip(numbers, views, strict=True)
        ]
        return {
            "images": np.stack([view.image for view in views])[:, None],
            "cells": np.stack([view.cells for view in views]),
            "points_a": np.stack([pair[2].a for pair in pairs]),
            "points_b": np.stack([pair[2].b for pair in pairs]),
            "valid": np.stack([pair[2].valid for pair in pairs]),
            "negative": np.stack([pair[2].negative for pair in pairs]),
            "stability_points": np.stack([points for points, _ in taught]),
            "stability": np.stack([codes for _, codes in taught]),
        }

    def _pair(self, rng: np.random.Generator) -> tuple[TrackedView, TrackedView, Correspondences]:
        if self.replay and rng.uniform() < self.settings.pairs.replay_share:
            first, second, (points_a, points_b, valid) = self.replay.pair(rng)
            return _unlabeled(first), _unlabeled(second), Correspondences(points_a, points_b, valid, valid)
        chosen = int(np.searchsorted(self._cumulative, rng.uniform(0, self._cumulative[-1]), side="right"))
        frames = self.sequences[chosen]
        frame_a = int(rng.choice(self._summaries[chosen].useful_frames(self._least)))
        a = frames.points(frame_a)
        frame_b, b = self._partner(rng, frames, frame_a, a)
        rows_a, rows_b = common_points(a, b)
        if not len(rows_a):
            view_a, view_b = self._anywhere(rng, frames, frame_a, a), self._anywhere(rng, frames, frame_b, b)
            return view_a, view_b, self._two_frames(rng, view_a, view_b, rows_a, rows_b)
        middle = int(rng.integers(len(rows_a)))
        view_a = self._view(rng, frames, frame_a, a, a.points[rows_a[middle]])
        visible = inside(view_a.known.points[rows_a], self.settings.views.width, self.settings.views.height)
        centre = np.median(b.points[rows_b][visible], axis=0) if visible.any() else b.points[rows_b[middle]]
        view_b = self._view(rng, frames, frame_b, b, centre)
        if frame_a == frame_b:
            return view_a, view_b, self._same_frame(rng, view_a, view_b, frames.size)
        return view_a, view_b, self._two_frames(rng, view_a, view_b, rows_a, rows_b)

    def _partner(
        self, rng: np.random.Generator, frames: LabeledFrames, frame_a: int, a: FramePoints
    ) -> tuple[int, FramePoints]:
        """Another frame, as far away as drawn or, where too few points are common, nearer; or the same one."""
        settings, last = self.settings.pairs, len(frames) - 1
        if rng.uniform() < settings.same_frame_share:
            return frame_a, a
        gap = self._gap(rng, frame_a, last)
        while abs(gap) >= 1:
            frame_b = int(np.clip(frame_a + round(gap), 0, last))
            if frame_b != frame_a:
                b = frames.points(frame_b)
                if len(common_points(a, b)[0]) >= settings.least_points:
                    return frame_b, b
            gap /= 2
        return frame_a, a

    def _gap(self, rng: np.random.Generator, frame: int, last: int) -> float:
        """Frames to another frame of a sequence that ends with frame `last`."""
        settings = self.settings.pairs
        if settings.wide_baselines:
            distance = settings.largest_gap * rng.uniform() ** (1 / (1 + settings.wide_baselines))
            return float(distance * rng.choice([-1, 1]))
        window = np.arange(max(frame - settings.largest_gap, 0), min(frame + settings.largest_gap, last) + 1)
        others = window[window != frame]
        return float(rng.choice(others) - frame) if len(others) else 0.0

    def _anywhere(self, rng: np.random.Generator, frames: LabeledFrames, frame: int, known: FramePoints) -> TrackedView:
        """A view that looks at any known point of a frame."""
        centre = known.points[rng.integers(len(known.points))] if len(known.points) else None
        return self._view(rng, frames, frame, known, centre)

    def _view(
        self, rng: np.random.Generator, frames: LabeledFrames, frame: int, known: FramePoints, centre: Float64 | None
    ) -> TrackedView:
        settings = self.settings
        width, height = settings.views.width, settings.views.height
        picture = frames.picture(frame)
        H = random_view(rng, settings.views, frames.size, centre)
        image = augment(warp_image(picture, H, width, height), rng, settings.photometric)
        mask = frames.mask(frame)
        used = np.ones_like(picture) if mask is None else mask.astype(np.uint8)
        visible = cv2.warpPerspective(used, H, (width, height), flags=cv2.INTER_NEAREST) > 0
        points = warp_points(H, known.points)
        # the detector loss ignores the cells of unstable and unknown points
        agreement = np.where(known.stability == STABLE, _CERTAIN, _UNDECIDED).astype(np.float32)
        cells = label_cells(points, agreement, visible, width, height, AdaptationSettings())
        if not settings.pairs.teach_detector:
            cells[:] = IGNORED
        if not settings.pairs.untracked_is_background:
            cells[cells == DUSTBIN] = IGNORED
        return TrackedView(image, cells, replace(known, points=points), H, None if mask is None else visible)

    def _two_frames(
        self, rng: np.random.Generator, a: TrackedView, b: TrackedView, rows_a: Int64, rows_b: Int64
    ) -> Correspondences:
        """Landmarks that both views show, and keypoints without a known partner: wrong partners for the others."""
        width, height, count = self.settings.views.width, self.settings.views.height, self.settings.pairs.points
        both = inside(a.known.points[rows_a], width, height) & inside(b.known.points[rows_b], width, height)
        chosen = rng.permutation(np.flatnonzero(both))[:count]
        result = _empty(count)
        number = len(chosen)
        result.a[:number], result.b[:number] = a.known.points[rows_a[chosen]], b.known.points[rows_b[chosen]]
        result.valid[:number] = True
        alone_a = _others(rng, a.known.points, rows_a, width, height)
        alone_b = _others(rng, b.known.points, rows_b, width, height)
        spare = min(count - number, len(alone_a), len(alone_b))
        result.a[number : number + spare], result.b[number : number + spare] = alone_a[:spare], alone_b[:spare]
        result.negative[: number + spare] = True
        return result

    def _same_frame(
        self, rng: np.random.Generator, a: TrackedView, b: TrackedView, size: tuple[int, int]
    ) -> Correspondences:
        """Every pixel has a partner: half of the places are known points of view a, the rest anywhere."""
        width, height, count = self.settings.views.width, self.settings.views.height, self.settings.pairs.points
        result = _empty(count)
        result.a[:] = rng.uniform((0, 0), (width - 1, height - 1), (count, 2))
        shown = a.known.points[inside(a.known.points, width, height) & (a.known.stability != UNSTABLE)]
        shown = shown[rng.permutation(len(shown))[: count // 2]]
        result.a[: len(shown)] = shown
        frame_from_a = np.linalg.inv(a.view_from_frame)
        places_b = warp_points(b.view_from_frame @ frame_from_a, result.a)
        result.valid[:] = inside(places_b, width, height) & inside(warp_points(frame_from_a, result.a), *size)
        result.valid[:] &= _on(a.used, result.a) & _on(b.used, places_b)
        result.b[:] = np.where(result.valid[:, None], places_b, 0)
        result.negative[:] = result.valid
        return result

    def _stability(self, rng: np.random.Generator, view: TrackedView) -> tuple[Float32, Int64]:
        """Labeled points (M, 2) of the view and 1 for stable, 0 for unstable: at most half of them unstable ones."""
        count = self.settings.pairs.stability_points
        points, codes = np.zeros((count, 2), np.float32), np.full(count, IGNORED, np.int64)
        known = view.known
        labeled = inside(known.points, self.settings.views.width, self.settings.views.height) & known.seen
        unstable = rng.permutation(np.flatnonzero(labeled & (known.stability == UNSTABLE)))[: count // 2]
        stable = rng.permutation(np.flatnonzero(labeled & (known.stability == STABLE)))
        rows = np.concatenate([unstable, stable])[:count]
        points[: len(rows)] = known.points[rows]
        codes[: len(rows)] = known.stability[rows] == STABLE
        return points, codes


def _unlabeled(view: View) -> TrackedView:
    """A view of a picture of which no stability is known."""
    nothing = FramePoints(np.zeros((0, 2)), np.zeros(0, np.int64), np.zeros(0, np.int8), np.zeros(0, np.bool_))
    return TrackedView(view.image, view.cells, nothing, view.view_from_picture)


def _on(used: NDArray[np.bool_] | None, points: NDArray[Any]) -> NDArray[np.bool_]:
    """(N,) whether points (N, 2) lie on used pixels; NaN does not, nor what lies outside a mask."""
    known = np.isfinite(points).all(axis=1)
    if used is None:
        return np.asarray(known)
    return np.asarray(known & unmasked(np.where(known[:, None], points, -1).astype(np.float32), used))


def _empty(count: int) -> Correspondences:
    zeros = np.zeros((count, 2), np.float32)
    return Correspondences(zeros, zeros.copy(), np.zeros(count, np.bool_), np.zeros(count, np.bool_))


def _others(rng: np.random.Generator, points: Float64, common: Int64, width: int, height: int) -> Float64:
    """Points of a view that are not among the common ones, shuffled."""
    alone = inside(points, width, height)
    alone[common] = False
    return points[rng.permutation(np.flatnonzero(alone))]
