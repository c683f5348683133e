"""Dense stability over the image (paper, Figure "Stability Classifier in Action")."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from improvo.report.canvas import Canvas
from improvo.report.palettes import PALETTES, RGB, Palette
from improvo.types import Features, Float32, Float64, Mask, UInt8

_PINK: RGB = (255, 105, 200)
_SUPPRESSED = 0.5  # keypoints of a lower stability count as suppressed
_REACH = 14  # pixels; suppressed keypoints this close belong to one region
_MIN_KEYPOINTS = 4  # of a region
_MAX_REGIONS = 6


class StabilityFrontend(Protocol):
    """A network with a stability head."""

    def __call__(self, image: UInt8, mask: Mask | None = None) -> Features: ...

    def stability_map(self, image: UInt8) -> Float32: ...


def paint_stability(
    image: UInt8,
    frontend: StabilityFrontend,
    name: str,
    palette: Palette = PALETTES["paper"],
    width: int = 1280,
    mask: Mask | None = None,
) -> UInt8:
    """The picture of one frame: heat from stable to unstable, keypoints, circles around suppressed regions.

    Raises:
        InputError: the network has no stability head.
    """
    stability = frontend.stability_map(image)
    features = frontend(image) if mask is None else frontend(image, mask)
    assert features.stability is not None  # stability_map has raised otherwise
    heat = palette.ramp_colours(1 - stability.ravel(), 0, 1).reshape(*stability.shape, 3)
    mixed = (0.55 * image[..., None] + 0.45 * heat).astype(np.uint8)
    canvas = Canvas(mixed, brightness=1.0, width=width)
    low = features.stability < _SUPPRESSED
    canvas.dots(features.keypoints[~low], np.full(((~low).sum(), 3), 255, np.uint8), 1.2)
    canvas.dots(features.keypoints[low], np.zeros((low.sum(), 3), np.uint8), 1.6)
    centres, radii = suppressed_regions(features.keypoints[low], image.shape[:2])
    canvas.rings(centres, radii, _PINK, thickness=2 * canvas.scale)
    return canvas.with_caption(
        f"{name}: {int((~low).sum())} stable keypoints (white), {int(low.sum())} suppressed (black), "
        f"circled: {len(centres)}",
        (palette.ramp_strip(), "stable", "unstable"),
    )


def suppressed_regions(keypoints: Float32, shape: tuple[int, int]) -> tuple[Float64, Float64]:
    """Centres (R, 2) and radii (R,) in pixels of the regions with most suppressed keypoints (N, 2), most first."""
    import cv2

    mask = np.zeros(shape, np.uint8)
    columns = np.clip(np.rint(keypoints[:, 0]).astype(int), 0, shape[1] - 1)
    rows = np.clip(np.rint(keypoints[:, 1]).astype(int), 0, shape[0] - 1)
    mask[rows, columns] = 1
    reach = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_REACH, _REACH))
    _, regions = cv2.connectedComponents(cv2.dilate(mask, reach))
    region = regions[rows, columns]
    counts = np.bincount(region, minlength=1)
    chosen = [r for r in np.argsort(-counts, kind="stable") if counts[r] >= _MIN_KEYPOINTS][:_MAX_REGIONS]
    centres = np.array([keypoints[region == r].mean(axis=0) for r in chosen], np.float64).reshape(-1, 2)
    radii = np.array(
        [
            np.linalg.norm(keypoints[region == r] - centre, axis=1).max() + 8.0
            for r, centre in zip(chosen, centres, strict=True)
        ],
        np.float64,
    )
    return centres, radii
