"""The network that a training starts from: random, or given weights, widened where they are narrower."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from improvo.errors import ConfigError
from improvo.frontend.architecture import ARCHITECTURES, Architecture
from improvo.frontend.channel_pruning import without_dead_channels
from improvo.frontend.superpoint import SuperPoint
from improvo.frontend.weights_files import Weights, load_weights
from improvo.training.widen import widen

STEM_LAYERS = 4  # of the encoder, at full and half resolution


def published_architecture(name: str) -> Architecture:
    """What a named network is saved as, whatever channels of it are used. VO adaptation adds the stability head."""
    return replace(ARCHITECTURES[name], stability=False)


def first_network(name: str, seed: int, start: Path | None, stem: int = 0) -> SuperPoint:
    """A network without the stability head, which only VO adaptation can teach.

    Args:
        name: of the architecture.
        seed: of random weights.
        start: weights to start from; None starts from random ones.
        stem: channels of the first four layers; 0 for as many as the parent uses, or the architecture has.

    Raises:
        ConfigError: the architecture has fewer channels in the first four layers.
        InputError: weights that cannot be widened to the architecture.
    """
    architecture = published_architecture(name)
    weights = load_weights(start) if start else None
    if stem > min(architecture.encoder[:STEM_LAYERS]):
        raise ConfigError(f"setting `stem_channels`: {name} has {min(architecture.encoder[:STEM_LAYERS])}, not {stem}")
    if stem:
        architecture = replace(architecture, encoder=(stem,) * STEM_LAYERS + architecture.encoder[STEM_LAYERS:])
    elif weights and _widths(weights.architecture) == _widths(architecture):
        architecture = replace(without_dead_channels(weights).architecture, stability=False)
    return started_network(architecture, seed, weights)


def started_network(architecture: Architecture, seed: int, weights: Weights | None) -> SuperPoint:
    """A network with the given weights, widened where it is wider. What they lack stays random.

    Args:
        architecture: of the network.
        seed: of what is random.
        weights: None leaves all of it random.
    """
    torch.manual_seed(seed)
    network = SuperPoint(architecture)
    if weights is None:
        return network
    weights = without_dead_channels(weights)
    heads = ("encoder", "detector", "descriptor", *(("stability",) if architecture.stability else ()))
    own = {key: value for key, value in weights.tensors.items() if key.partition(".")[0] in heads}
    if _widths(weights.architecture) != _widths(network.architecture):
        own = widen(own, weights.architecture, network.architecture, np.random.default_rng(seed))
    network.load_state_dict({key: torch.from_numpy(value) for key, value in own.items()}, strict=False)
    return network


def _widths(architecture: Architecture) -> Architecture:
    return replace(architecture, name="", stability=False)
