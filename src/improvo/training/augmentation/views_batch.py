"""Many random views at once: what `views.random_view` draws one by one, as arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from improvo.training.settings import ViewSettings
from improvo.types import Float64

_CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float64)


def random_views(rng: np.random.Generator, settings: ViewSettings, sizes: Float64, centres: Float64) -> Float64:
    """Homographies (V, 3, 3) from picture pixels to view pixels; see `views.random_view`.

    Args:
        sizes: (V, 2) width, height of the pictures.
        centres: (V, 2) where in the picture a view looks, about; NaN looks anywhere that keeps it within the picture.
    """
    size = np.array([settings.width, settings.height], np.float64)
    largest = np.minimum(settings.largest_zoom, 1.1 * (sizes / size).min(axis=1))
    smallest = np.minimum(settings.smallest_zoom, largest)
    zoom = np.exp(rng.uniform(np.log(smallest), np.log(largest)))[:, None]
    half = 0.5 * size * zoom
    offset = rng.uniform(-1, 1, sizes.shape)
    anywhere = sizes / 2 + offset * np.maximum(sizes / 2 - half, 0.0)
    about = np.clip(
        np.nan_to_num(centres) + offset * settings.shift * size * zoom,
        np.minimum(0.6 * half, sizes / 2),
        np.maximum(sizes - 0.6 * half, sizes / 2),
    )
    centre = np.where(np.isnan(centres), anywhere, about)
    quads = _random_quads(rng, settings, half)
    while not (good := _convex(quads)).all():
        quads[~good] = _random_quads(rng, settings, half[~good])
    target = (_CORNERS + 1) / 2 * (size - 1)
    H = _homographies(quads + centre[:, None], target)
    depth = (H[:, 2, :2] * centre).sum(axis=1) + H[:, 2, 2]  # positive in view, whatever the solver's sign
    return np.asarray(H * np.sign(depth)[:, None, None])


def _random_quads(rng: np.random.Generator, settings: ViewSettings, half: Float64) -> Float64:
    """Corners (V, 4, 2) of the views in the picture, about their centres; `half` (V, 2) of the upright views' size."""
    count = len(half)
    moved = rng.uniform(-2, 2, (count, 4, 2)) * settings.perspective * rng.uniform(size=(count, 1, 1))
    quads = (_CORNERS + moved) * half[:, None]
    direction, amount = rng.uniform(0, np.pi, count), np.exp(rng.uniform(-0.5, 0.5, count) * settings.stretch)
    basis = _rotations(direction)
    diagonal = np.zeros((count, 2, 2))
    diagonal[:, 0, 0], diagonal[:, 1, 1] = amount, 1 / amount
    turned = _rotations(np.radians(settings.rotation_degrees) * rng.triangular(-1, 0, 1, count))
    return np.asarray(quads @ (turned @ basis @ diagonal @ basis.transpose(0, 2, 1)).transpose(0, 2, 1))


def _rotations(angles: Float64) -> Float64:
    """(V, 2, 2)."""
    c, s = np.cos(angles), np.sin(angles)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)


def _convex(quads: Float64) -> NDArray[np.bool_]:
    """(V,) whether the corners turn the same way, none of them sharply: a view that a camera can have."""
    edges = np.roll(quads, -1, axis=1) - quads
    following = np.roll(edges, -1, axis=1)
    turn = edges[..., 0] * following[..., 1] - edges[..., 1] * following[..., 0]
    sharp = 0.3 * np.linalg.norm(edges, axis=2) * np.linalg.norm(following, axis=2)
    return np.asarray((turn > sharp).all(axis=1))


def _homographies(source: Float64, target: Float64) -> Float64:
    """(V, 3, 3) from four points (V, 4, 2) to four points (4, 2); the last entry is 1 before normalising the source."""
    middle = source.mean(axis=1, keepdims=True)
    scale = np.abs(source - middle).max(axis=(1, 2), keepdims=True)
    x, y = np.moveaxis((source - middle) / scale, 2, 0)
    u, v = (np.broadcast_to(target[:, axis], x.shape) for axis in (0, 1))
    one, zero = np.ones_like(x), np.zeros_like(x)
    rows_u = np.stack([x, y, one, zero, zero, zero, -u * x, -u * y], axis=-1)
    rows_v = np.stack([zero, zero, zero, x, y, one, -v * x, -v * y], axis=-1)
    system = np.concatenate([rows_u, rows_v], axis=1)
    solved = np.linalg.solve(system, np.concatenate([u, v], axis=1)[..., None])[..., 0]
    H = np.concatenate([solved, np.ones((len(source), 1))], axis=1).reshape(-1, 3, 3)
    normalise = np.zeros_like(H)
    normalise[:, 0, 0] = normalise[:, 1, 1] = 1 / scale[:, 0, 0]
    normalise[:, :2, 2] = -middle[:, 0] / scale[:, 0]
    normalise[:, 2, 2] = 1
    return np.asarray(H @ normalise)
