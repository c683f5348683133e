"""Put trained weights into the package, with what was measured: python recipes/bundle.py WEIGHTS NAME [POSE.json ...]

The figures of `improvo evaluate pose` (rows of that label) go into the model card, and activation ranges over the
pictures of --calibrate, which the int8 runtime needs.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from improvo.cli.train_options import read_data_card
from improvo.frontend.quantisation import calibrate
from improvo.frontend.weights_files import BUNDLED, DataSource, Weights, find_weights, load_weights, save_weights

FIGURES = ("pairs", "rotation_success", "translation_success", "right_share_3px", "right_share_8px")
NO_HEAD = "The stability head is not part of these weights: only VO adaptation can teach it. "
ATTRIBUTION = (
    "All frames were converted to greyscale, reduced and re-compressed. The authors of the data sets do not endorse "
    "this work. None of the pictures is of redkitchen, hololens-office, checkerboard-desk, kitti00 or fr3-notexture, "
    "which these weights may be judged on; icl-nuim, tartanair, tum fr3 and icsl-corridor may not be used for that."
)


def pose_figures(path: Path, label: str) -> dict[str, Any]:
    """Success by estimator and gap of one frontend of a `pose.json`."""
    figures: dict[str, Any] = {}
    for row in json.loads(path.read_text())["rows"]:
        if row["frontend"] == label:
            entry = {key: row[key] for key in FIGURES if key in row}
            figures.setdefault(row["estimator"], {})[str(row["gap"])] = entry
    return figures


def with_ancestors(data: tuple[DataSource, ...], ancestors: list[str]) -> tuple[DataSource, ...]:
    """The sources, and those of the weights (bundled names or files) that these came from, each once."""
    sources = {source.name: source for source in data}
    for ancestor in ancestors:
        for source in load_weights(find_weights(ancestor)).card.data:
            sources.setdefault(source.name, source)
    return tuple(sources.values())


def with_stability_odds(weights: Weights, ratio: float) -> Weights:
    """The same weights, with the odds of "stable" multiplied by `ratio` everywhere."""
    bias = weights.tensors["stability.1.convolution.bias"].copy()  # (2,) logits of unstable and stable
    bias[1] += np.float32(np.log(ratio))
    return replace(weights, tensors={**weights.tensors, "stability.1.convolution.bias": bias})


def main() -> None:
    """Write the bundled file and its card."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", type=Path)
    parser.add_argument("name", help="of the bundled weights")
    parser.add_argument("pose", nargs="*", metavar="SEQUENCE=POSE.json")
    parser.add_argument(
        "--data-card", type=Path, help="what the weights were trained on, where their card does not say it all"
    )
    parser.add_argument("--start", help="the bundled weights that they began as")
    parser.add_argument(
        "--ancestor", action="append", default=[], metavar="WEIGHTS", help="weights whose data these come from too"
    )
    parser.add_argument("--label", help="of its rows in the POSE.json files, if not the name")
    parser.add_argument("--commit", help="of the code that trained them, where it was not yet committed")
    parser.add_argument(
        "--stability-odds",
        type=float,
        default=1.0,
        metavar="RATIO",
        help="stable points to an unstable one where the weights will be used; the head was trained on one to one",
    )
    parser.add_argument("--calibrate", type=Path, metavar="FOLDER", help="pictures for the int8 runtime")
    arguments = parser.parse_args()
    weights = load_weights(arguments.weights)
    poses = {}
    for entry in arguments.pose:
        sequence, _, path = entry.partition("=")
        poses[sequence] = pose_figures(Path(path), arguments.label or arguments.name)
    training = {key: value for key, value in weights.card.metrics.items() if key != "pose"}
    card = replace(
        weights.card,
        metrics={**training, **({"pose": poses} if poses else {})},
        notes=f"{'' if weights.architecture.stability else NO_HEAD}{ATTRIBUTION}",
    )
    if arguments.data_card:
        card = replace(card, data=read_data_card(arguments.data_card))
    card = replace(card, data=with_ancestors(card.data, arguments.ancestor))
    if arguments.start:
        card = replace(card, training={**card.training, "start": arguments.start})
    if arguments.commit:
        card = replace(card, commit=arguments.commit)
    if arguments.stability_odds != 1:
        odds = f"The stability head was trained on balanced labels; its odds times {arguments.stability_odds:g}. "
        card = replace(card, notes=odds + card.notes)
        weights = with_stability_odds(weights, arguments.stability_odds)
    weights = replace(weights, card=card)
    if arguments.calibrate:
        files = sorted(arguments.calibrate.glob("*.jpg"))
        files = files[:: max(1, len(files) // 40)]
        weights = calibrate(weights, (cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files))
    BUNDLED.mkdir(exist_ok=True)
    save_weights(BUNDLED / f"{arguments.name}.safetensors", weights.tensors, weights.card)


if __name__ == "__main__":
    main()
