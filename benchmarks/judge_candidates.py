"""Candidate weights for `benchmarks/judge.py`: bundled and given ones, sums of them, and spoiled ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from improvo.frontend.weights_files import Weights, find_weights, load_weights, save_weights

MIXED = (-0.5, 0.25, 0.5, 0.75, 1.5)  # of the way from the first to the second; beyond 0 to 1 it goes past them
NOISE = (0.03, 0.06, 0.1, 0.15, 0.2)  # of every weight, relative
HEAD_NOISE = (0.1, 0.2, 0.4)  # of the weights of one head, relative to their spread
LEVELS = (4, 6, 12)  # values that a weight of a layer may have to either side of 0
RANGES = (0.35, 0.6, 2.5)  # times the activation ranges that int8 needs: clipped, or coarse


def written(folder: Path, base: str, former: Path | None) -> dict[str, Path]:
    """Candidates by name, those that are made here in a folder.

    Args:
        folder: for files.
        base: weights that are spoiled.
        former: other weights of the same layers, which are mixed with it; may be none.
    """
    folder.mkdir(parents=True, exist_ok=True)
    weights = load_weights(find_weights(base))
    rng = np.random.default_rng(0)
    made: dict[str, Weights] = {}
    if former is not None:
        other = load_weights(former)
        for share in MIXED:
            made[f"mixed {share:g}"] = _mixed(other, weights, share)
    for amount in NOISE:
        made[f"noise {amount:g}"] = _noisy(weights, amount, "", rng)
    for head in ("descriptor", "detector"):
        for amount in HEAD_NOISE:
            made[f"{head} noise {amount:g}"] = _noisy(weights, amount, head, rng)
    for levels in LEVELS:
        coarse = {name: _rounded(value, levels) for name, value in weights.tensors.items()}
        made[f"{levels} levels"] = _with(weights, coarse)
    for factor in RANGES:
        ranges = {name: factor * largest for name, largest in weights.card.activation_ranges.items()}
        made[f"ranges x {factor:g}"] = Weights(replace(weights.card, activation_ranges=ranges), weights.tensors)
    found = {}
    for name, candidate in made.items():
        found[name] = folder / f"{name.replace(' ', '-')}.safetensors"
        if not found[name].is_file():
            save_weights(found[name], candidate.tensors, candidate.card)
    return found


def _with(weights: Weights, tensors: dict[str, np.ndarray]) -> Weights:
    return Weights(weights.card, {name: np.asarray(value, np.float32) for name, value in tensors.items()})


def _mixed(former: Weights, weights: Weights, share: float) -> Weights:
    between = {name: (1 - share) * value + share * weights.tensors[name] for name, value in former.tensors.items()}
    return _with(
        weights, {name: np.maximum(v, 1e-6) if name.endswith("running_var") else v for name, v in between.items()}
    )


def _noisy(weights: Weights, amount: float, head: str, rng: np.random.Generator) -> Weights:
    changed = {}
    for name, value in sorted(weights.tensors.items()):
        if name.startswith(head) and name.endswith("convolution.weight"):
            spread = float(value.std()) if head else np.abs(value)
            value = value + amount * spread * rng.standard_normal(value.shape)
        changed[name] = value
    return _with(weights, changed)


def _rounded(value: np.ndarray, levels: int) -> np.ndarray:
    if value.ndim < 4:
        return value
    step = np.abs(value).max() / levels
    return np.rint(value / step) * step
