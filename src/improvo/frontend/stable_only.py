"""A frontend that drops keypoints with a low stability (paper, "Visualizing Stability")."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from improvo.errors import ConfigError
from improvo.frontend import Frontend
from improvo.types import Features, Mask


class StableOnly:
    """Drops keypoints whose stability is below a threshold, before they are matched.

    A weight (w_ij) keeps an unstable keypoint in use where there is nothing better. Dropping it also keeps its wrong
    matches out of initialisation and RANSAC.

    Args:
        frontend: with a stability head.
        least: probability in (0, 1].
    """

    def __init__(self, frontend: Frontend, least: float) -> None:
        self.frontend, self.least = frontend, least
        self.name = frontend.name

    def __call__(self, image: NDArray[Any], mask: Mask | None = None) -> Features:
        """Features of an image, best first; where there is a mask, on its True pixels.

        Raises:
            ConfigError: the frontend has no stability head.
        """
        features = self.frontend(image) if mask is None else self.frontend(image, mask)
        if features.stability is None:
            raise no_stability_head(self.name)
        return features.take(features.stability >= self.least)


def no_stability_head(name: str) -> ConfigError:
    """What is told where a frontend has none."""
    return ConfigError(f"frontend {name}: has no stability head, so least_stability must be 0; superpoint-vo has one")
