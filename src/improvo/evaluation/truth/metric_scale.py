"""How many metres a unit of a reconstruction is: by depth images, or by a trajectory in metres."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from improvo.errors import InputError
from improvo.evaluation.truth.structure_from_motion import ReconstructedImage
from improvo.geometry.alignment import align_points, path_lengths
from improvo.geometry.depth_sampling import depth_at
from improvo.types import Float32, Float64

ROBUST = 1.4826  # median absolute deviation to standard deviation


@dataclass(frozen=True)
class MetricScale:
    """A scale, and how well its sources agree."""

    scale: float  # metres per unit
    images: int  # that said something about it
    spread: float  # between images, relative (robust standard deviation)
    disagreement: float  # by depth: median relative difference of depths; by trajectory: error as a share of its path


def scale_from_depth(
    images: tuple[ReconstructedImage, ...], depth: Callable[[int], Float32 | None], min_depths: int
) -> MetricScale | None:
    """The median over images of each one's median ratio of measured to reconstructed depth.

    Args:
        images: of the reconstruction.
        depth: for an image's place in `images`, its depth (H, W) in metres, registered to the raw image, NaN where
            missing; None without one.
        min_depths: points with depth that an image must have.

    Returns:
        None where no image has enough of them.
    """
    ratios = []
    for row, image in enumerate(images):
        measured = depth(row) if len(image.pixels) >= min_depths else None
        if measured is None:
            continue
        ratio = depth_at(image.pixels.astype(np.float32), measured) / image.depth
        ratio = ratio[np.isfinite(ratio) & (ratio > 0)]
        if len(ratio) >= min_depths:
            ratios.append(ratio)
    if not ratios:
        return None
    medians = np.array([np.median(ratio) for ratio in ratios])
    scale = float(np.median(medians))
    disagreement = float(np.median(np.abs(np.concatenate(ratios) / scale - 1.0)))
    return MetricScale(scale, len(ratios), _relative_spread(medians), disagreement)


def scale_from_poses(world_from_cam: Float64, metric_world_from_cam: Float64) -> MetricScale:
    """The scale of the similarity that carries camera centres onto those of a trajectory in metres.

    Its spread is that of the scales of single stretches: a tenth of the images apart.

    Args:
        world_from_cam: (N, 4, 4) of the reconstruction.
        metric_world_from_cam: (N, 4, 4) of the same images, NaN where unknown.

    Raises:
        InputError: fewer than three common poses, or a camera that stands still.
    """
    known = np.isfinite(metric_world_from_cam).all(axis=(1, 2))
    centres, metric = world_from_cam[known, :3, 3], metric_world_from_cam[known, :3, 3]
    motion = align_points(metric, centres, with_scale=True)
    path = float(path_lengths(metric)[-1])
    error = float(np.sqrt(np.mean(np.sum((motion.apply(centres) - metric) ** 2, axis=1))))
    if path <= 0 or motion.scale <= 0:
        raise InputError("the scale is undefined: the trajectory stands still")
    step = max(len(centres) // 10, 1)
    own, given = (np.linalg.norm(c[step:] - c[:-step], axis=1) for c in (centres, metric))
    moving = own > 0.1 * own.max()
    return MetricScale(motion.scale, int(known.sum()), _relative_spread(given[moving] / own[moving]), error / path)


def _relative_spread(values: Float64) -> float:
    centre = float(np.median(values))
    return ROBUST * float(np.median(np.abs(values - centre))) / centre
