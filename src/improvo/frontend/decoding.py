"""From the network's maps to keypoints, descriptors and stability, in NumPy (paper, "Convolutional Frontend").

Conventions: the centre of the top-left pixel is (0, 0), and the cell (i, j) is centred on (8j + 3.5, 8i + 3.5).
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from improvo.frontend.architecture import CELL
from improvo.frontend.masking import unmasked
from improvo.frontend.settings import NetworkSettings
from improvo.types import Features, Float32, Int64, Mask


class NetworkMaps(NamedTuple):
    """The network's output for a batch; the arrays may be overwritten by the next call of the runtime."""

    heat: Float32  # (B, H, W) keypoint probability of every pixel: softmax over a cell, dustbin dropped
    descriptors: Float32  # (B, Hc, Wc, D) one per cell, not normalised
    stability_logits: Float32 | None  # (B, Hc, Wc, 2), the second is "stable"; None without a stability head


def decode(
    maps: NetworkMaps, row: int, image: Float32, settings: NetworkSettings, mask: Mask | None = None
) -> Features:
    """Features of image `row` of the batch, best score first.

    Args:
        maps: of images that were padded at the right and the bottom.
        row: position in the batch.
        image: (H, W) grey in [0, 1], before padding; keypoints are found only within.
        settings: how.
        mask: (H, W) True where keypoints may be. A masked pixel suppresses none beside it.
    """
    height, width = image.shape
    heat = maps.heat[row, :height, :width]
    if mask is not None:
        heat = np.where(mask, heat, np.float32(0))
    pixels = find_keypoints(heat, settings)
    scores = heat[pixels[:, 1], pixels[:, 0]]
    keypoints = (
        refine(heat, pixels, settings.subpixel_radius) if settings.subpixel_radius else pixels.astype(np.float32)
    )
    found = np.ones(len(keypoints), np.bool_)
    if settings.corner_radius:
        from improvo.frontend.corners import refine_to_corners

        keypoints, found = refine_to_corners(image, keypoints, settings.corner_radius)
    if settings.subpixel_radius or settings.corner_radius:  # they moved: to one place, or to a masked pixel
        kept = first_at_place(keypoints)
        kept = kept[found[kept]]
        if mask is not None:
            kept = kept[unmasked(keypoints[kept], mask)]
        keypoints, scores = keypoints[kept], scores[kept]
    descriptors = sample_descriptors(maps.descriptors[row], keypoints)
    stability = None
    if maps.stability_logits is not None:
        stability = stability_probability(_sample(maps.stability_logits[row], keypoints))
    return Features(keypoints, descriptors, scores, stability)


def find_keypoints(heat: Float32, settings: NetworkSettings) -> Int64:
    """Pixels (N, 2) x, y of the best local maxima of a heat map (H, W), best first; ties in reading order."""
    border = settings.border
    size = 2 * settings.nms_radius + 1
    best_around = cv2.dilate(heat, np.ones((size, size), np.uint8))  # outside the image counts as minus infinity
    kept = (heat == best_around) & (heat > settings.threshold)
    inner = kept[border : heat.shape[0] - border, border : heat.shape[1] - border]
    y, x = np.nonzero(inner)
    y, x = y + border, x + border
    best_first = np.argsort(-heat[y, x], kind="stable")[: settings.max_keypoints]
    return np.stack([x[best_first], y[best_first]], axis=1).astype(np.int64)


def refine(heat: Float32, pixels: Int64, radius: int) -> Float32:
    """Keypoints (N, 2): the centre of mass of the heat map in the square of `radius` around each pixel (N, 2)."""
    padded = cv2.copyMakeBorder(heat, radius, radius, radius, radius, cv2.BORDER_CONSTANT, value=0)
    steps = np.arange(2 * radius + 1)
    first = pixels[:, 1] * padded.shape[1] + pixels[:, 0]  # of each square, in reading order
    square = (steps[:, None] * padded.shape[1] + steps).ravel()
    patches = padded.ravel()[first[:, None] + square]  # (N, size of the square)
    y, x = np.meshgrid(steps - radius, steps - radius, indexing="ij")
    moments = patches @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1).astype(np.float32)
    return np.asarray(pixels + moments[:, :2] / moments[:, 2:], np.float32)


def first_at_place(keypoints: Float32) -> Int64:
    """Rows, in order, of the first keypoint (N, 2) at every whole pixel: two may have moved to one corner."""
    _, first = np.unique(np.round(keypoints).astype(np.int64), axis=0, return_index=True)
    return np.sort(first)


def sample_descriptors(cells: Float32, keypoints: Float32) -> Float32:
    """Unit descriptors (N, D) at keypoints (N, 2): cells (Hc, Wc, D) normalised, interpolated, normalised again."""
    corners, weights = _corners(cells, keypoints)
    of_unit_corners = weights / _length(corners)
    sampled = np.matmul(of_unit_corners[:, None], corners)[:, 0]
    return np.asarray(sampled / _length(sampled)[:, None])


def stability_probability(logits: Float32) -> Float32:
    """Softmax over the last axis (..., 2): the probability of the second class, "stable"."""
    with np.errstate(over="ignore"):  # 1 / (1 + inf) is right
        return np.asarray(1.0 / (1.0 + np.exp(logits[..., 0] - logits[..., 1])), np.float32)


def stability_map(logits: Float32, height: int, width: int) -> Float32:
    """Probability (height, width) that a keypoint at a pixel is stable, from logits (Hc, Wc, 2).

    As in the paper, the logits are interpolated, then the softmax is taken.
    """
    size = (logits.shape[1] * CELL, logits.shape[0] * CELL)
    # cv2.resize takes pixel areas to pixel areas: its centre of cell j is 8j + 3.5, as ours
    pixels = cv2.resize(np.ascontiguousarray(logits), size, interpolation=cv2.INTER_LINEAR)
    return stability_probability(pixels[:height, :width])


def _sample(cells: Float32, keypoints: Float32) -> Float32:
    corners, weights = _corners(cells, keypoints)
    return np.matmul(weights[:, None], corners)[:, 0]


def _length(vectors: Float32) -> Float32:
    return np.asarray(np.maximum(np.sqrt(np.einsum("...c,...c->...", vectors, vectors)), np.float32(1e-12)))


def _corners(cells: Float32, keypoints: Float32) -> tuple[Float32, Float32]:
    """The four cells (N, 4, C) around each keypoint and their bilinear weights (N, 4); beyond the edge the edge."""
    rows, columns, channels = cells.shape
    x0, x1, right = _neighbours(keypoints[:, 0], columns)
    y0, y1, below = _neighbours(keypoints[:, 1], rows)
    places = np.stack([y0 * columns + x0, y0 * columns + x1, y1 * columns + x0, y1 * columns + x1], axis=1)
    weights = np.stack([(1 - below) * (1 - right), (1 - below) * right, below * (1 - right), below * right], axis=1)
    return cells.reshape(-1, channels).take(places, axis=0), weights


def _neighbours(pixels: Float32, cells: int) -> tuple[Int64, Int64, NDArray[np.float32]]:
    position = np.clip((pixels - (CELL - 1) / 2) / CELL, 0, cells - 1)
    before = np.minimum(position.astype(np.int64), max(cells - 2, 0))
    return before, np.minimum(before + 1, cells - 1), (position - before).astype(np.float32)
