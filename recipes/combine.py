"""A weights file that is a sum of others: python recipes/combine.py OUT WEIGHTS=FACTOR... --of COMMIT

Factors sum to one. What a training made of weights is added to what another made of the same weights so:
`further=0.5 adapted=1 start=-0.5`. A head that some of the files do not have is the mean of the others', by their
factors. The card is that of the first file, with all factors and the data of all. Ranges for int8 must be measured
anew.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from improvo.errors import ConfigError
from improvo.frontend.weights_files import Weights, find_weights, load_weights, save_weights


def combined(parts: list[tuple[str, Weights, float]]) -> Weights:
    """The sum, tensor by tensor.

    Args:
        parts: name, weights and factor of each; the first has all tensors, and its card is kept.

    Raises:
        ConfigError: factors that do not sum to one, of a head that only some have to zero, a head that the first has
            not, or a negative variance of a batch norm.
    """
    if abs(sum(factor for _, _, factor in parts) - 1) > 1e-6:
        raise ConfigError("factors: must sum to one")
    left_out = {name for _, weights, _ in parts for name in weights.tensors} - set(parts[0][1].tensors)
    if left_out:
        raise ConfigError(f"{min(left_out)}: is not in the first file, whose layers the sum has; give another first")
    tensors = {}
    for name in parts[0][1].tensors:
        having = [
            (weights.tensors[name].astype(np.float64), factor)
            for _, weights, factor in parts
            if name in weights.tensors
        ]
        whole = sum(factor for _, factor in having)
        if abs(whole) < 1e-6:
            raise ConfigError(f"{name}: the factors of those that have it sum to zero; take others")
        tensors[name] = np.asarray(sum(values * (factor / whole) for values, factor in having), np.float32)
        if name.endswith("running_var") and tensors[name].min() < 0:
            raise ConfigError(f"{name}: negative; take a smaller factor")
    card = parts[0][1].card
    data = {source.name: source for _, weights, _ in parts for source in weights.card.data}
    factors = {name: factor for name, _, factor in parts}
    return Weights(
        replace(
            card,
            data=tuple(data.values()),
            training={**card.training, "combined": factors},
            activation_ranges={},
        ),
        tensors,
    )


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("parts", nargs="+", metavar="WEIGHTS=FACTOR")
    parser.add_argument("--of", metavar="COMMIT", required=True, help="that the weights behind the first are of")
    arguments = parser.parse_args()
    parts = []
    for part in arguments.parts:
        name, _, factor = part.rpartition("=")
        path = find_weights(name)
        label = "of this training" if not parts else f"{path.stem} of commit {arguments.of}"
        parts.append((label, load_weights(path), float(factor)))
    weights = combined(parts)
    save_weights(arguments.output, weights.tensors, weights.card)


if __name__ == "__main__":
    main()
