"""Sequences with depth and poses: which frames show the same places, and where a point of one lies in another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from improvo.training.held_settings import DevicePairSettings
from improvo.types import Float32, Float64, Int64, Mask, UInt8

_GRID = (16, 12)  # points along x and y on which overlap is measured
_COARSE_TOLERANCE = 0.1  # of depths between grid points, relative
_BINS = np.array([0.0, 0.35, 0.5, 0.65, 0.8])  # pairs are drawn evenly over these classes of overlap


@dataclass(frozen=True)
class PosedSequence:
    """A recording with known poses and depth, in memory."""

    name: str
    pictures: tuple[UInt8, ...]  # grey (H, W), undistorted, all of one size
    times: Float64  # (N,) seconds
    K: Float64  # (3, 3) of the pictures
    world_from_cam: Float64  # (N, 4, 4)
    inverse_depth: tuple[Float32, ...]  # (h, w) each, a grid over the picture; 0 where nothing is known
    weight: float = 1.0  # how often it is drawn from, relative to the others
    masks: tuple[Mask, ...] = ()  # (H, W) each, which pixels are used; empty for all of all pictures

    @property
    def size(self) -> tuple[int, int]:
        """Width, height of the pictures."""
        height, width = self.pictures[0].shape
        return width, height


@dataclass(frozen=True)
class FramePairs:
    """Pairs of frames of one sequence that overlap, by class of overlap."""

    frames: Int64  # (P, 2) a, b
    starts: Int64  # (C + 1,) rows of `frames` at which the classes that are not empty begin; the last is P
    places: Float32  # (P, G, 4) x, y in frame a and x, y in frame b of a grid over frame a; NaN where hidden

    def draw(self, rng: np.random.Generator) -> tuple[int, int, Float64, Float64]:
        """Two frames of a class drawn evenly, and a place (2,) in either that both show."""
        row = self.draw_row(rng)
        places = self.places[row]
        place = places[rng.choice(np.flatnonzero(np.isfinite(places[:, 0])))].astype(np.float64)
        return int(self.frames[row, 0]), int(self.frames[row, 1]), place[:2], place[2:]

    def draw_row(self, rng: np.random.Generator) -> int:
        """The row of a pair of a class drawn evenly."""
        chosen = int(rng.integers(len(self.starts) - 1))
        return int(rng.integers(self.starts[chosen], self.starts[chosen + 1]))


def block_inverse_depth(depth: NDArray[np.floating], side: int = 4, largest_step: float = 1.06) -> Float32:
    """Inverse depth of the blocks of a depth image; exact on planes, 0 on steps and where depth is missing.

    Args:
        depth: (H, W) metres along the axis; 0 or not finite where missing.
        side: pixels of a block.
        largest_step: ratio of the depths within a block beyond which it shows two things.
    """
    height, width = (length // side * side for length in depth.shape)
    known = np.isfinite(depth) & (depth > 0)
    inverse = np.where(known, 1 / np.where(known, depth, 1), 0)[:height, :width]
    blocks = inverse.reshape(height // side, side, width // side, side)
    least, most = blocks.min(axis=(1, 3)), blocks.max(axis=(1, 3))
    return np.where((least > 0) & (most < largest_step * least), blocks.mean(axis=(1, 3)), 0).astype(np.float32)


def overlapping_pairs(sequence: PosedSequence, settings: DevicePairSettings) -> FramePairs | None:
    """All ordered pairs of different frames with enough overlap in both directions; None where there are none."""
    count, (width, height) = len(sequence.times), sequence.size
    gap = np.abs(sequence.times[:, None] - sequence.times)
    near = (gap <= settings.largest_gap + 1e-6) & ~np.eye(count, dtype=np.bool_)
    x, y = (
        (np.arange(points) + 0.5) * side / points - 0.5 for points, side in zip(_GRID, (width, height), strict=True)
    )
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    inverse = np.stack([_nearest(values, grid, sequence.size) for values in sequence.inverse_depth])  # (N, G)
    overlap = np.zeros((count, count))
    places: dict[tuple[int, int], Float32] = {}
    for a in range(count):
        others = np.flatnonzero(near[a])
        if len(others):
            in_b = _carried(sequence, a, others, grid, inverse[a])
            overlap[a, others] = np.isfinite(in_b[..., 0]).mean(axis=1) / max((inverse[a] > 0).mean(), 0.25)
            places.update({(a, int(b)): _both(grid, in_b[row]) for row, b in enumerate(others)})
    least = np.minimum(overlap, overlap.T)
    frames = np.argwhere(near & (least >= max(settings.least_overlap, 1e-3)))
    if not len(frames):
        return None
    classes = np.searchsorted(_BINS, least[frames[:, 0], frames[:, 1]], side="right")
    order = np.argsort(classes, kind="stable")
    frames = frames[order]
    starts = np.flatnonzero(np.diff(classes[order], prepend=-1))
    return FramePairs(
        frames.astype(np.int64),
        np.append(starts, len(frames)).astype(np.int64),
        np.stack([places[int(first), int(second)] for first, second in frames]),
    )


def _carried(sequence: PosedSequence, a: int, others: Int64, grid: Float64, inverse: Float64) -> Float64:
    """Pixels (M, G, 2) in the other frames of the grid over frame a; NaN where not visible there."""
    rays = np.column_stack([grid, np.ones(len(grid))]) @ np.linalg.inv(sequence.K).T
    known = inverse > 0
    points = rays / np.where(known, inverse, 1.0)[:, None]
    b_from_a = np.linalg.inv(sequence.world_from_cam[others]) @ sequence.world_from_cam[a]
    seen = points @ b_from_a[:, :3, :3].transpose(0, 2, 1) + b_from_a[:, None, :3, 3]  # (M, G, 3)
    depth = seen[..., 2]
    pixels = seen @ sequence.K.T
    pixels = pixels[..., :2] / np.where(depth > 0.05, depth, 1.0)[..., None]
    width, height = sequence.size
    inside = known & (depth > 0.05) & ((pixels >= 0) & (pixels <= (width - 1, height - 1))).all(axis=-1)
    there = np.stack(
        [_nearest(sequence.inverse_depth[b], np.where(inside[m, :, None], pixels[m], 0), sequence.size)
         for m, b in enumerate(others)]
    )  # fmt: skip
    agrees = np.abs(depth * there - 1) < _COARSE_TOLERANCE
    return np.where((inside & agrees)[..., None], pixels, np.nan)


def _both(grid: Float64, in_b: Float64) -> Float32:
    visible = np.isfinite(in_b[:, :1])
    return np.concatenate([np.where(visible, grid, np.nan), in_b], axis=1).astype(np.float32)


def _nearest(values: Float32, pixels: Float64, size: tuple[int, int]) -> Float64:
    """(G,) entries of a map (h, w) over a frame of a size (width, height) at pixels (G, 2) of the frame."""
    height, width = values.shape
    column = ((pixels[:, 0] + 0.5) * width / size[0]).astype(np.int64).clip(0, width - 1)
    row = ((pixels[:, 1] + 0.5) * height / size[1]).astype(np.int64).clip(0, height - 1)
    return values[row, column].astype(np.float64)
