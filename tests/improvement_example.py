"""A small self-improvement for tests: changing the weights at random stands in for training.

Run as a program, it does one run of the loop: `improvement_example.py OUT SECONDS SEQUENCE...`.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from improvo.evaluation.pose.self_truth import SelfTruthSettings
from improvo.files import make_output_folder, write_json
from improvo.frontend.settings import FrontendSettings
from improvo.frontend.weights_files import Weights, find_weights, load_weights, save_weights
from improvo.improvement.improve import Improvement, improve
from improvo.improvement.recipe import TrainingJob
from improvo.improvement.settings import ImproveSettings, SplitSettings, ValidationSettings
from improvo.odometry.settings import OdometrySettings, StartSettings
from improvo.stability.settings import LabelQualitySettings, LabelSettings

_HELD = ImproveSettings().held
LABELS_TEACH = replace(_HELD, pairs=replace(_HELD.pairs, whole_frames=0))  # whole frames need none
SPOILED = "spoiled"  # stands for bundled weights with so much noise that a sixth of the matches is lost
SETTINGS = ImproveSettings(
    frontend=FrontendSettings(SPOILED, max_keypoints=250),
    # a dozen frames of one wall, by a spoiled network, are no evidence that the odometry is right
    labels=LabelSettings(min_observations=6, quality=LabelQualitySettings(enabled=False)),
    odometry=OdometrySettings(start=StartSettings(min_points=20)),  # the room is mostly one wall
    held=LABELS_TEACH,
    split=SplitSettings(0.3),
    validation=ValidationSettings(
        SelfTruthSettings(pairs=6, max_keypoints=250, shuffles=2), gaps=(4, 8), min_pairs=2, calibration_images=2
    ),
)
NOISE = (0.0, 0.5)  # of the first round, which gives the bundled weights back, and of the second, which ruins them


class FakeTraining:
    """Gives bundled weights with noise, as told; what it was given is kept.

    Args:
        noise: relative change of all weights, one number a round.
        seconds: that a round takes.
    """

    def __init__(self, noise: Sequence[float] = NOISE, seconds: float = 0.0) -> None:
        self.noise, self.seconds = noise, seconds
        self.calls: list[dict[str, Any]] = []

    def __call__(self, job: TrainingJob) -> dict[str, Any]:
        output, seed = job.output, job.seed
        seen = [one.labeled.frames.source_index[one.fixed_run().has_depth].tolist() for one in job.reference]
        self.calls.append(
            {
                "labels": [job.labels],
                "seed": seed,
                "start": job.start,
                "seen": seen,
                "control": job.control,
                "steps": job.steps,
                "first": job.first,
            }
        )
        make_output_folder(output, "train held")
        for part in range(20):  # as steps: something to interrupt
            time.sleep(self.seconds / 20)
            write_json(output / "checkpoint.json", part)
        weights = noisy(self.noise[min(seed, len(self.noise) - 1)], seed)
        rows = [{"step": step, "loss": 1.0 / step} for step in (1, 2, 3)]
        (output / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        card = replace(weights.card, activation_ranges={}, training={"stage": "odometry", "seconds": 1, "steps": 3})
        job.weights.parent.mkdir(exist_ok=True)
        save_weights(job.weights, weights.tensors, card)
        return rows[-1]


def noisy(noise: float, seed: int) -> Weights:
    """The weights of `superpoint-small` with relative noise."""
    weights, rng = load_weights(find_weights("superpoint-small")), np.random.default_rng(seed)
    tensors = {
        name: (value * np.exp(noise * rng.standard_normal(value.shape))).astype(np.float32)
        for name, value in sorted(weights.tensors.items())
    }
    return replace(weights, tensors=tensors)


def run(
    output: Path, sequences: Sequence[Path], train: FakeTraining, rounds: int | None = 2, **options: Any
) -> Improvement:
    """One run of the loop."""
    settings = options.pop("settings", SETTINGS)
    if settings.frontend.name == SPOILED:
        weights, path = noisy(0.3, 5), output.with_name("spoiled.safetensors")
        save_weights(path, weights.tensors, weights.card)
        settings = replace(settings, frontend=replace(settings.frontend, name=str(path)))
    return improve(list(sequences), output, settings, rounds, train=train, **options)


if __name__ == "__main__":
    run(Path(sys.argv[1]), [Path(word) for word in sys.argv[3:]], FakeTraining(seconds=float(sys.argv[2])))
