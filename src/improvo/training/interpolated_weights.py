"""Weights on the straight line from where a training started to where it ended.

Weights so interpolated keep most of what was learned and lose less of what was known (Wortsman et al., "Robust
fine-tuning of zero-shot models", CVPR 2022): they are those of one network, and cost nothing more in use.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from improvo import files
from improvo.errors import InputError
from improvo.frontend.channel_pruning import with_dead_channels, without_dead_channels
from improvo.frontend.weights_files import Weights, load_weights, save_weights


def interpolated(start: Weights, trained: Weights, share: float) -> Weights:
    """`(1 - share) * start + share * trained`, tensor by tensor, with the card of the trained ones.

    Heads that the start lacks are the trained ones. The card has no activation ranges, which must be measured anew.

    Args:
        start: weights.
        trained: from these, of the same layers.
        share: of the way, 0 to 1.

    Raises:
        InputError: layers of different width, as after a training that widened them.
    """
    ours, theirs = without_dead_channels(start).tensors, without_dead_channels(trained).tensors
    mixed = dict(theirs)
    for name in ours.keys() & theirs.keys():
        if ours[name].shape != theirs[name].shape:
            raise InputError(f"weights: `{name}` is {ours[name].shape} and {theirs[name].shape}; nothing lies between")
        mean = (1 - share) * ours[name].astype(np.float64) + share * theirs[name].astype(np.float64)
        mixed[name] = mean.astype(np.float32)
    card = replace(trained.card, activation_ranges={})
    return Weights(card, with_dead_channels(mixed, card.architecture))


def write_interpolated(starts: Sequence[tuple[Path, float]], trained: Path, output: Path) -> None:
    """See `interpolated`, one after the other; the card of the file says of which weights it is the mean.

    Args:
        starts: weights, and the share of the way from these.
        trained: weights that the first way leads to; each other one leads to where the one before it has ended.
        output: weights file to write.

    Raises:
        InputError: weights that cannot be read, or between which nothing lies.
    """
    result = load_weights(trained)
    for start, share in starts:
        result = interpolated(load_weights(start), result, share)
    ends = [{"start": start.name, "start_sha256": files.content_hash(start), "share": share} for start, share in starts]
    training = {**result.card.training, "interpolated": ends}
    save_weights(output, result.tensors, replace(result.card, training=training))
