"""Random homographies of the kind that a handheld camera makes, and points carried through them."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from improvo.training.settings import ViewSettings
from improvo.types import Float32, Float64


def warp_points(H: NDArray[Any], points: NDArray[Any]) -> Float64:
    """Points (..., 2) through the homography (3, 3); a point at or beyond the horizon becomes NaN."""
    homogeneous = points @ H[:, :2].T + H[:, 2]
    depth = homogeneous[..., 2:]
    return np.where(depth > 1e-6, homogeneous[..., :2] / np.where(depth > 1e-6, depth, 1.0), np.nan)


def inside(points: NDArray[Any], width: int, height: int, margin: float = 0.0) -> NDArray[np.bool_]:
    """Whether points lie within the image; NaN does not.

    Args:
        points: (..., 2) pixels.
        width: of the image, pixels.
        height: of the image, pixels.
        margin: pixels along its edge that are outside.

    Returns:
        (...,) bool.
    """
    x, y = points[..., 0], points[..., 1]
    within = (x >= margin) & (y >= margin) & (x <= width - 1 - margin) & (y <= height - 1 - margin)
    return np.asarray(within, np.bool_)


def random_view(
    rng: np.random.Generator,
    settings: ViewSettings,
    picture_size: tuple[int, int],
    centre: Float64 | None = None,
) -> Float64:
    """A homography (3, 3) from picture pixels to view pixels.

    Args:
        rng: of all choices.
        settings: what a view may be.
        picture_size: width, height of the picture.
        centre: (2,) where in the picture the view looks, about; None looks anywhere that keeps it within the picture.
    """
    size = np.array([settings.width, settings.height], np.float64)
    picture = np.array(picture_size, np.float64)
    largest = min(settings.largest_zoom, 1.1 * float((picture / size).min()))
    smallest = min(settings.smallest_zoom, largest)
    zoom = float(np.exp(rng.uniform(np.log(smallest), np.log(largest))))
    half = 0.5 * size * zoom
    if centre is None:
        room = np.maximum(picture / 2 - half, 0.0)
        centre = picture / 2 + rng.uniform(-1, 1, 2) * room
    else:
        centre = centre + rng.uniform(-1, 1, 2) * settings.shift * size * zoom
        centre = np.clip(centre, np.minimum(0.6 * half, picture / 2), np.maximum(picture - 0.6 * half, picture / 2))
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float64)
    target = (corners + 1) / 2 * (size - 1)
    while True:
        quad = centre + _random_quad(rng, settings, corners, half)
        if _convex(quad):
            break
    H = cv2.getPerspectiveTransform(quad.astype(np.float32), target.astype(np.float32))
    # OpenCV makes H[2, 2] = 1, which is negative depth in the view where the picture's corner is beyond the horizon
    return np.asarray(H * np.sign(H[2, :2] @ quad.mean(axis=0) + H[2, 2]))


def _random_quad(rng: np.random.Generator, settings: ViewSettings, corners: Float64, half: Float64) -> Float64:
    """The view's corners (4, 2) in the picture, about its centre; `half` is half the size of the upright view."""
    quad = (corners + rng.uniform(-2, 2, (4, 2)) * settings.perspective * rng.uniform()) * half
    quad = quad @ _stretch(rng, settings.stretch).T
    angle = np.radians(settings.rotation_degrees) * rng.triangular(-1, 0, 1)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return np.asarray(quad @ rotation.T)


def warp_image(image: np.ndarray, H: Float64, width: int, height: int) -> np.ndarray:
    """The view of an image. What lies outside it is mirrored, so that no edge appears there.

    Args:
        image: (H, W).
        H: (3, 3) image to view.
        width: of the view, pixels.
        height: of the view, pixels.

    Returns:
        (height, width).
    """
    return cv2.warpPerspective(image, H, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)


def cell_centres(width: int, height: int) -> Float32:
    """(Hc·Wc, 2) centres of the 8×8 cells, row by row."""
    y, x = np.mgrid[0 : height // 8, 0 : width // 8]
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float32) * 8 + 3.5


def _stretch(rng: np.random.Generator, largest: float) -> Float64:
    """(2, 2) anisotropic scaling of unit determinant along a random direction."""
    angle, amount = rng.uniform(0, np.pi), np.exp(0.5 * rng.uniform(-largest, largest))
    c, s = np.cos(angle), np.sin(angle)
    basis = np.array([[c, -s], [s, c]])
    return basis @ np.diag([amount, 1 / amount]) @ basis.T


def _convex(quad: Float64) -> bool:
    """Whether the corners turn the same way, none of them sharply: a view that a camera can have."""
    edges = np.roll(quad, -1, axis=0) - quad
    following = np.roll(edges, -1, axis=0)
    turn = edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0]
    return bool((turn > 0.3 * np.linalg.norm(edges, axis=1) * np.linalg.norm(following, axis=1)).all())
