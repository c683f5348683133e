"""A wide network that starts as a narrow one: channels are doubled so that it computes the same function.

Training the narrow network first and widening it spends less time per picture while there is most to learn (Chen,
Goodfellow and Shlens, "Net2Net", 2016; here the shares of the copies are drawn per weight, so that they can part ways).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from improvo.errors import InputError
from improvo.frontend.architecture import Architecture
from improvo.frontend.weights_files import expected_shapes
from improvo.types import Float32


def widen(
    tensors: Mapping[str, Float32], source: Architecture, target: Architecture, rng: np.random.Generator
) -> dict[str, Float32]:
    """Tensors of a wide network that compute what those of a narrow one compute; descriptors keep their cosines.

    Args:
        tensors: of the narrow network, by name.
        source: the narrow architecture.
        target: the wide architecture.
        rng: how the copies of a channel differ.

    Raises:
        InputError: a width of the target is not a multiple of the source's, or the normalisation differs.
    """
    if source.normalisation != target.normalisation:
        raise InputError(f"{source.name} cannot be widened to {target.name}: their batch norm differs")
    wide = {}
    for name, shape in expected_shapes(target).items():
        if name not in tensors:
            raise InputError(f"{source.name} cannot be widened to {target.name}: it has no {name}")
        values = tensors[name]
        copies = [to // size for to, size in zip(shape, values.shape, strict=True)]
        if any(size * n != to for size, n, to in zip(values.shape, copies, shape, strict=True)):
            raise InputError(f"{source.name} cannot be widened to {target.name}: {name} is not a whole multiple")
        repeated = np.tile(values, copies)
        if values.ndim == 4 and copies[1] > 1:
            repeated = repeated * _shares(rng, shape, copies[1])
        wide[name] = repeated.astype(np.float32)
    return wide


def _shares(rng: np.random.Generator, shape: tuple[int, ...], copies: int) -> Float32:
    """Factors for a convolution's weights that sum to 1 over the copies of an input."""
    parts = rng.uniform(0.25, 0.75, (shape[0], copies, shape[1] // copies, *shape[2:]))
    return np.asarray((parts / parts.sum(axis=1, keepdims=True)).reshape(shape), np.float32)
