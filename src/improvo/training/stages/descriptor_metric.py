"""A linear map of descriptors, in closed form: descriptors of one place come near each other, likely mistakes do not.

KISSME (Koestinger et al., "Large Scale Metric Learning from Equivalence Constraints", CVPR 2012): differences of
descriptors that belong together and of those that do not are taken as two Gaussians of mean zero with covariances S
and N. The logarithm of the ratio of their densities is, up to a constant, the squared distance under the matrix
S^-1 - N^-1. A square root of it maps descriptors so that ordinary distances say the same. The descriptor head ends in
a linear layer, and what it puts out is brought to unit length, so that the map becomes part of that layer and costs
nothing in use.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from improvo.config import check_seed
from improvo.errors import ConfigError, InputError
from improvo.frontend.weights_files import Weights
from improvo.training.setting_checks import Checks
from improvo.types import Features, Float32, Float64, Int64

_LAST = "descriptor.1.convolution"  # the layer that the map becomes part of


class NoDescriptorMapError(InputError):
    """The keypoints that were found again do not tell a map."""


@dataclass(frozen=True)
class MetricSettings:
    """How the map is made; importable without torch."""

    longer_side: int = 640  # pixels; larger pictures are reduced on loading
    max_keypoints: int = 500  # of a frame
    pairs: int = 1500  # of frames whose descriptors are compared
    two_frames: bool = True  # pairs are two frames, related by depth and poses; False: a frame and a view of it
    views_per_frame: int = 2  # of the control, homographies of every frame
    right_px: float = 3.0  # two keypoints that are mutually nearest, and nearer than this, show the same place
    masked_px: float = 8.0  # keypoints nearer than this to the right one are no wrong partners
    # of both covariances towards a multiple of the identity: 1 leaves the descriptors as they are
    shrinkage: float = 0.03
    seed: int = 0

    def __post_init__(self) -> None:
        checks = Checks(self)
        checks.at_least(1, "pairs", "views_per_frame")
        checks.at_least(50, "max_keypoints")
        checks.at_least(16, "longer_side")
        checks.positive("right_px", "masked_px")
        check_seed(self.seed)
        if not 0 < self.shrinkage <= 1:
            raise ConfigError(f"setting `shrinkage`: must be above 0 and at most 1, not {self.shrinkage}")


class Scatter:
    """Covariances of differences between descriptors of the same place, and of the likeliest mistakes.

    Args:
        dimensions: D, of a descriptor.
    """

    def __init__(self, dimensions: int) -> None:
        self.same = np.zeros((dimensions, dimensions))
        self.wrong = np.zeros((dimensions, dimensions))
        self.count = 0  # correspondences

    def add(self, a: Features, b: Features, matches: Int64, masked_px: float) -> None:
        """Count in the correspondences of a pair of frames.

        Args:
            a, b: features of the frames, with unit descriptors.
            matches: (K, 2) keypoints of a and b that show the same place.
            masked_px: keypoints of b this near to the right one are no mistakes.
        """
        others = np.asarray(b.descriptors, np.float32)
        first, second = np.asarray(a.descriptors, np.float32)[matches[:, 0]], others[matches[:, 1]]
        apart = np.linalg.norm(b.keypoints[matches[:, 1], None] - b.keypoints, axis=2)
        likely = np.where(apart < masked_px, -np.inf, first @ others.T)
        mistaken = np.isfinite(likely).any(axis=1)
        first, second, likely = first[mistaken], second[mistaken], likely[mistaken]
        same, wrong = first - second, first - others[likely.argmax(axis=1)]
        self.same += same.T @ same
        self.wrong += wrong.T @ wrong
        self.count += len(first)

    def map(self, shrinkage: float) -> Float64:
        """(D, D) symmetric: `map @ descriptor`, of the length that descriptors had in the mean over all directions.

        Args:
            shrinkage: of the covariances towards a multiple of the identity, above 0 and at most 1.

        Raises:
            NoDescriptorMapError: too few correspondences, or they say nothing.
        """
        least = 4 * len(self.same)
        if self.count < least:
            raise NoDescriptorMapError(
                f"descriptors: {self.count} keypoints were found again in another frame where {least} are needed; "
                "give more frames, or ones that show the same places"
            )
        difference = _inverse(self.same / self.count, shrinkage) - _inverse(self.wrong / self.count, shrinkage)
        values, vectors = np.linalg.eigh(difference)
        values = np.maximum(values, 0.0)  # a direction in which mistakes are nearer than the right ones says nothing
        if not values.sum() > 0:
            raise NoDescriptorMapError(
                "descriptors: those of the same place are no nearer than wrong ones; check the poses"
            )
        root = (vectors * np.sqrt(values)) @ vectors.T
        return np.asarray(root * np.sqrt(len(root) / (root**2).sum()))


def with_descriptor_map(weights: Weights, matrix: Float64) -> Weights:
    """The weights with their descriptors mapped by (D, D); detector and stability stay as they are to the bit.

    Descriptors between cells are a mean of the cells' unit ones, so that they are those mapped up to the small change
    in the cells' lengths.
    """
    kernel, bias = (weights.tensors[f"{_LAST}.{part}"].astype(np.float64) for part in ("weight", "bias"))
    mapped = {
        f"{_LAST}.weight": np.einsum("od,dihw->oihw", matrix, kernel).astype(np.float32),
        f"{_LAST}.bias": (matrix @ bias).astype(np.float32),
    }
    return replace(weights, tensors={**weights.tensors, **mapped})


def found_again(keypoints_b: Float32, places: Float64, shown: np.ndarray, right_px: float) -> Int64:
    """Keypoints (K, 2) of frames a and b that show the same place: mutually nearest, and near.

    Args:
        keypoints_b: (M, 2) pixels.
        places: (N, 2) where the keypoints of a are in b, pixels.
        shown: (N,) bool, whether b shows them.
        right_px: they are nearer than this.
    """
    rows = np.flatnonzero(shown)
    if not len(rows) or not len(keypoints_b):
        return np.zeros((0, 2), np.int64)
    apart = np.linalg.norm(places[rows, None] - keypoints_b, axis=2)
    nearest = apart.argmin(axis=1)
    own = np.arange(len(rows))
    right = (apart[own, nearest] < right_px) & (apart.argmin(axis=0)[nearest] == own)
    return np.stack([rows[right], nearest[right]], axis=1).astype(np.int64)


def _inverse(covariance: Float64, shrinkage: float) -> Float64:
    size = len(covariance)
    return np.asarray(
        np.linalg.inv((1 - shrinkage) * covariance + shrinkage * np.trace(covariance) / size * np.eye(size))
    )
