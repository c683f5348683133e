"""What every stage does with its output folder: one settings record, one process, weights with their model card."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from improvo import __version__, config, files
from improvo.continuation import SettingsRecord
from improvo.folder_lock import locked
from improvo.frontend.architecture import Architecture
from improvo.frontend.channel_pruning import with_dead_channels
from improvo.frontend.weights_files import DataSource, ModelCard, load_weights, save_weights
from improvo.training.distributed import Process
from improvo.training.held_settings import HeldSettings
from improvo.training.metrics import METRICS, read_metrics
from improvo.training.settings import HomographiesSettings, OdometryTrainingSettings, ShapesSettings
from improvo.training.stages.base import Stage
from improvo.training.trainer import Batches, Trainer

WEIGHTS = "weights.safetensors"
_NOT_STATED = "not stated"  # as the licence of data
SETTINGS = "settings.yaml"
StageSettings = ShapesSettings | HomographiesSettings | OdometryTrainingSettings | HeldSettings
# what a continued run may change: none of these alters a step that was already made
_FREE = ("steps", "decay_steps", "device", "threads", "workers", "checkpoint_minutes", "log_every")


@contextmanager
def stage_folder(output: Path, stage: str) -> Iterator[None]:
    """Make the output folder of a stage (`shapes`, ...), and be the only one to work in it within the block.

    Processes that train together count as one.

    Raises:
        OutputError: the folder is not ours, cannot be written, or another training is at work there.
    """
    files.make_output_folder(output, f"train {stage}")
    if not Process.current().leads:
        yield
        return
    with locked(output):
        yield


def run_stage(
    stage: Stage,
    batches: Batches,
    settings: StageSettings,
    output: Path,
    card: ModelCard,
    progress: bool,
    seconds: float = 0.0,
) -> dict[str, Any]:
    """Train, and leave weights, card, metrics and settings in the folder; continues what is already there.

    Args:
        stage: network and losses.
        batches: the data, by step.
        settings: of the stage; recorded in the folder.
        output: the folder.
        card: what is known of the weights before they are trained.
        progress: show it.
        seconds: see `Trainer`.

    Returns:
        The last row of metrics.

    Raises:
        ConfigError: the folder was begun with other settings.
        OutputError: see `stage_folder`.
    """
    with stage_folder(output, card.training["stage"]):
        _same_settings(output / SETTINGS, settings)
        trainer = Trainer(stage, batches, settings.optimiser, output, seconds)
        resumed = trainer.resume()

        def last_row() -> dict[str, Any]:
            rows = read_metrics(output / METRICS)
            return rows[-1] if rows else {"step": trainer.step}

        def save(trainer: Trainer) -> None:
            pruned = {name: value.cpu().numpy() for name, value in trainer.average.network.state_dict().items()}
            tensors = with_dead_channels(pruned, card.architecture)
            training = {**card.training, "steps": trainer.step, "seconds": round(trainer.seconds)}
            save_weights(output / WEIGHTS, tensors, replace(card, training=training, metrics=last_row()))

        if resumed and _saved_steps(output / WEIGHTS) != trainer.step:
            save(trainer)  # killed between the checkpoint and these
        trainer.run(progress, on_checkpoint=save)
        return last_row()


def model_card(
    architecture: Architecture,
    stage: str,
    settings: StageSettings,
    data: tuple[DataSource, ...],
    start: Path | None,
) -> ModelCard:
    """The card of weights without a stability head, as far as it is known before training.

    Args:
        architecture: that the weights are saved as.
        stage: `shapes`, `homographies`, `odometry` or `held`.
        settings: of the stage.
        data: that is trained on; the card also names all that the weights had learned from before.
        start: weights that are started from; None for random ones.
    """
    return ModelCard(
        architecture=architecture,
        licence="Apache-2.0",
        data=learned_from(load_weights(start).card.data if start else (), data),
        training={
            "stage": stage,
            "start": start.name if start else "random",
            "start_sha256": files.content_hash(start) if start else "",
            "stability_trained": False,
            "seed": settings.optimiser.seed,
            "settings": config.to_dict(settings),
            "versions": {"improvo": __version__, "torch": str(torch.__version__), "numpy": np.__version__},
        },
        commit=commit_of_code(),
        notes="The stability head is not part of these weights: only VO adaptation can teach it.",
    )


def not_stated(names: Iterable[str]) -> tuple[DataSource, ...]:
    """Data of which nobody said the licence."""
    return tuple(DataSource(name, _NOT_STATED) for name in names)


def learned_from(before: tuple[DataSource, ...], now: tuple[DataSource, ...]) -> tuple[DataSource, ...]:
    """All that weights have seen, each source once; what is not stated now may have been before.

    Args:
        before: of the weights that were started from.
        now: of this training.
    """
    known = {source.name: source for source in before}
    stated = [known.get(each.name, each) if each.licence == _NOT_STATED else each for each in now]
    return tuple({each.name: each for each in (*stated, *(each for each in before if each not in stated))}.values())


def commit_of_code() -> str:
    """The commit of the code, where it runs from a checkout."""
    import subprocess

    git = shutil.which("git")
    if git is None:
        return ""
    here = Path(__file__).parent
    answer = subprocess.run([git, "-C", str(here), "rev-parse", "HEAD"], capture_output=True, text=True, check=False)
    return answer.stdout.strip()


def _saved_steps(path: Path) -> int:
    """The step that a weights file is of; -1 where there is none."""
    return int(load_weights(path).card.training["steps"]) if path.is_file() else -1


def _same_settings(path: Path, settings: StageSettings) -> None:
    """Remember the settings of the folder; refuse to continue it under others."""
    record = SettingsRecord(path, type(settings), [*(f"optimiser.{name}" for name in _FREE), "memory_mib"])
    values = config.to_dict(settings)
    record.check(values, "give the same settings or another output folder")
    record.write(values)
