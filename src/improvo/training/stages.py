"""The training stages as verbs: from settings and pictures to a folder with weights, model card and metrics."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from improvo import __version__, config, files
from improvo.continuation import SettingsRecord
from improvo.errors import ConfigError, InputError
from improvo.frontend.architecture import ARCHITECTURES, Architecture
from improvo.frontend.channel_pruning import with_dead_channels, without_dead_channels
from improvo.frontend.superpoint import SuperPoint
from improvo.frontend.weights import DataSource, ModelCard, Weights, load_weights, save_weights
from improvo.training.adaptation import Detector, adapt, network_detector, shi_tomasi
from improvo.training.homographies import JointStage
from improvo.training.labels import PointLabels, load_labels, save_labels
from improvo.training.magic_point import MagicPointStage
from improvo.training.pairs import PairBatches
from improvo.training.pictures import Pictures, load_pictures
from improvo.training.settings import HeldSettings, HomographiesSettings, OdometryTrainingSettings, ShapesSettings
from improvo.training.synthetic import ShapeBatches, shape_source
from improvo.training.trainer import Batches, Stage, Trainer, choose_device
from improvo.training.widen import widen

if TYPE_CHECKING:
    from improvo.labeling.labeled import LabeledSequence

WEIGHTS = "weights.safetensors"
SETTINGS = "settings.yaml"
LABELS = "labels.npz"
STEM_LAYERS = 4  # of the encoder, at full and half resolution
StageSettings = ShapesSettings | HomographiesSettings | OdometryTrainingSettings | HeldSettings
LABEL_STORES = "label-stores.json"
SHAPES = DataSource("procedural shapes", "Apache-2.0", "Drawn by improvo.training.shapes.")


def train_shapes(
    settings: ShapesSettings, output: Path, start: Path | None = None, progress: bool = True
) -> dict[str, Any]:
    """Stage 1: a detector from drawn shapes alone; returns the last row of metrics."""
    network, parent = _network(settings.architecture, settings.optimiser.seed, start)
    card = model_card(_published(settings.architecture), "shapes", settings, (SHAPES,), parent)
    return run_stage(
        MagicPointStage(network, settings.detector), ShapeBatches(settings), settings, output, card, progress
    )


def train_homographies(
    sources: Sequence[str],
    settings: HomographiesSettings,
    output: Path,
    start: Path | None = None,
    detector: Path | None = None,
    data: tuple[DataSource, ...] = (),
    progress: bool = True,
) -> dict[str, Any]:
    """Stage 2: homographic adaptation of the pictures, then joint training; returns the last row of metrics.

    Args:
        sources: see `load_pictures`.
        start: weights to start from; None starts from random ones.
        detector: weights whose detector labels the pictures; None takes classical corners.
        data: what the model card says about the pictures; the sources' names where it is empty.
    """
    pictures = load_pictures(sources, settings.longer_side, progress)
    for name in pictures.skipped:
        print(f"skipped {name}: cannot be read")
    if pictures.skipped:
        print(f"{len(pictures.skipped)} pictures skipped, {len(pictures)} read")
    network, parent = _network(settings.architecture, settings.optimiser.seed, start, settings.stem_channels)
    files.make_output_folder(output, "train homographies")
    labels = _labels(pictures, settings, output, detector, progress)
    if not data:
        data = tuple(DataSource(source.name, "not stated") for source in pictures.sources)
    if settings.shapes:
        weight = settings.shapes_share / (1 - settings.shapes_share) * sum(s.weight for s in pictures.sources)
        source, drawn = shape_source(settings.shapes, settings.optimiser.seed, weight)
        pictures = replace(pictures, sources=(*pictures.sources, source))
        labels, data = [*labels, drawn], (*data, SHAPES)
    card = model_card(_published(settings.architecture), "homographies", settings, data, parent)
    card.training.update(
        detector_labels=str(detector.name) if detector else "shi-tomasi", pictures=len(pictures),
        pictures_skipped=len(pictures.skipped),
    )  # fmt: skip
    stage = JointStage(network, settings)
    return run_stage(stage, PairBatches(pictures, labels, settings), settings, output, card, progress)


def train_odometry(
    labels: Sequence[Path],
    settings: OdometryTrainingSettings,
    output: Path,
    start: Path,
    data: tuple[DataSource, ...] = (),
    progress: bool = True,
    pictures: Sequence[str] = (),
) -> dict[str, Any]:
    """Stage 3, VO adaptation (paper, "Training Details"); returns the last row of metrics.

    Args:
        labels: label stores, as `improvo label` makes them; all their finished sequences are trained on.
        start: weights to start from; the stability head starts from random ones where they have none.
        data: what the model card says about the recordings; their names where it is empty.
        pictures: sources of homography pairs (`load_pictures`) that are rehearsed beside the labelled video.

    Raises:
        InputError: no store, a store whose labels have changed since the folder was begun, or no frame with enough
            stable points.
    """
    from improvo.labeling.labeled import read_labels
    from improvo.training.labeled_frames import LabeledFrames
    from improvo.training.tracked_pairs import TrackedPairs
    from improvo.training.vo_adaptation import VOAdaptationStage

    sequences = [sequence for folder in labels for sequence in read_labels(folder)]
    files.make_output_folder(output, "train odometry")
    _same_labels(output / LABEL_STORES, sequences)
    parent = load_weights(start)
    architecture = replace(without_dead_channels(parent).architecture, stability=True)
    network = started_network(architecture, settings.optimiser.seed, parent)
    frames = [LabeledFrames(sequence, settings.longer_side, settings.landmarks) for sequence in sequences]
    rehearsed, sources = _rehearsal(pictures, settings, output, progress)
    pairs = TrackedPairs(frames, settings, rehearsed)
    if not sum(len(useful) for useful in pairs.useful):
        least = settings.pairs.least_points
        raise InputError(
            f"{labels[0]}: no frame has {least} stable points; label more or livelier video, or lower "
            "pairs.least_points"
        )
    if not data:
        data = tuple(DataSource(name, "not stated") for name in (*(s.name for s in sequences), *sources))
    published = replace(parent.architecture, stability=True)
    card = model_card(published, "odometry", settings, data, start.name)
    card.training.update(
        stability_trained=True,
        sequences=len(sequences),
        frames=sum(sequence.record.frames for sequence in sequences),
        stable=sum(sequence.record.stable for sequence in sequences),
        unstable=sum(sequence.record.unstable for sequence in sequences),
    )
    stage = VOAdaptationStage(network, settings, pairs.stable_per_unstable)
    return run_stage(stage, pairs, settings, output, replace(card, notes=""), progress)


def _rehearsal(
    sources: Sequence[str], settings: OdometryTrainingSettings, output: Path, progress: bool
) -> tuple[PairBatches | None, list[str]]:
    """Homography pairs of pictures, labelled by corners as in stage 2, and the names of their sources."""
    if not sources:
        return None, []
    pictures = load_pictures(sources, settings.longer_side, progress)
    as_before = HomographiesSettings(
        longer_side=settings.longer_side, points=settings.pairs.points, optimiser=settings.optimiser,
        views=settings.views, photometric=settings.photometric,
    )  # fmt: skip
    labels = _labels(pictures, as_before, output, None, progress)
    return PairBatches(pictures, labels, as_before), [source.name for source in pictures.sources]


def _same_labels(path: Path, sequences: Sequence[LabeledSequence]) -> None:
    """Remember what a folder is trained on; refuse to continue it with other labels."""
    now = [[s.name, s.record.frames, s.record.tracks, s.record.stable, s.record.unstable] for s in sequences]
    record = SettingsRecord(path)
    if record.difference(now):
        raise InputError(f"{path.parent}: was begun with other labels; give the same stores or another output folder")
    record.write(now)


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
        seconds: see `Trainer`.
    """
    files.make_output_folder(output, f"train {card.training['stage']}")
    _same_settings(output / SETTINGS, settings)
    trainer = Trainer(stage, batches, settings.optimiser, output, seconds)
    resumed = trainer.resume()
    if resumed and progress:
        print(f"{output}: continues at step {trainer.step} of {trainer.settings.steps}")

    def save(trainer: Trainer) -> None:
        row = json.loads((output / "metrics.jsonl").read_text().splitlines()[-1])
        live = {name: value.cpu().numpy() for name, value in trainer.average.network.state_dict().items()}
        tensors = with_dead_channels(live, card.architecture)
        training = {**card.training, "steps": trainer.step, "seconds": round(trainer.seconds)}
        save_weights(output / WEIGHTS, tensors, replace(card, training=training, metrics=row))

    if resumed and _saved_steps(output / WEIGHTS) != trainer.step:
        save(trainer)  # killed between the checkpoint and these
    trainer.run(progress, on_checkpoint=save)
    last: dict[str, Any] = json.loads((output / "metrics.jsonl").read_text().splitlines()[-1])
    return last


def _saved_steps(path: Path) -> int:
    """The step that a weights file is of; -1 where there is none."""
    return int(load_weights(path).card.training["steps"]) if path.is_file() else -1


def _network(name: str, seed: int, start: Path | None, stem: int = 0) -> tuple[SuperPoint, str]:
    """A network without the stability head, which only VO adaptation can teach, and the name of its parent weights.

    Args:
        stem: channels of the first four layers; 0 for as many as the parent uses, or the architecture has.
    """
    architecture = _published(name)
    weights = load_weights(start) if start else None
    if stem > min(architecture.encoder[:STEM_LAYERS]):
        raise ConfigError(f"setting `stem_channels`: {name} has {min(architecture.encoder[:STEM_LAYERS])}, not {stem}")
    if stem:
        architecture = replace(architecture, encoder=(stem,) * STEM_LAYERS + architecture.encoder[STEM_LAYERS:])
    elif weights and _widths(weights.architecture) == _widths(architecture):
        architecture = replace(without_dead_channels(weights).architecture, stability=False)
    return started_network(architecture, seed, weights), start.name if start else ""


def _published(name: str) -> Architecture:
    """What a named network is saved as, whatever channels of it are used; VO adaptation adds the stability head."""
    if name not in ARCHITECTURES:
        raise ConfigError(f"architecture {name}: unknown; choose among {', '.join(ARCHITECTURES)}")
    return replace(ARCHITECTURES[name], stability=False)


def started_network(architecture: Architecture, seed: int, weights: Weights | None) -> SuperPoint:
    """A network with the given weights, widened where it is wider; what they lack stays random."""
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


def _labels(
    pictures: Pictures, settings: HomographiesSettings, output: Path, detector: Path | None, progress: bool
) -> list[list[PointLabels]]:
    """Labels of the pictures, made once and kept in the folder."""
    path = output / LABELS
    if path.is_file():
        return load_labels(path, [len(source.pictures) for source in pictures.sources])
    detect: Detector = shi_tomasi()
    if detector:
        weights = load_weights(detector)
        detect = network_detector(loaded(weights), choose_device(settings.optimiser.device), settings.adaptation)
    labels = adapt(pictures, detect, settings.adaptation, settings.views, settings.optimiser.seed, progress)
    if not sum(len(picture.points) for source in labels for picture in source):
        raise InputError("homographic adaptation found no keypoint in any picture; the detector has learned nothing")
    save_labels(path, labels)
    return labels


def loaded(weights: Weights) -> SuperPoint:
    """The network with these weights, for inference in torch."""
    network = SuperPoint(weights.architecture)
    network.load_state_dict({key: torch.from_numpy(value) for key, value in weights.tensors.items()}, strict=False)
    return network.eval()


def model_card(
    architecture: Architecture,
    stage: str,
    settings: StageSettings,
    data: tuple[DataSource, ...],
    parent: str,
) -> ModelCard:
    return ModelCard(
        architecture=architecture,
        licence="Apache-2.0",
        data=data,
        training={
            "stage": stage,
            "start": parent or "random",
            "stability_trained": False,
            "seed": settings.optimiser.seed,
            "settings": config.to_dict(settings),
            "versions": {"improvo": __version__, "torch": str(torch.__version__), "numpy": np.__version__},
        },
        commit=_commit(),
        notes="The stability head is not part of these weights: only VO adaptation can teach it.",
    )


def _commit() -> str:
    """The commit of the code, where it runs from a checkout."""
    import subprocess

    git = shutil.which("git")
    if git is None:
        return ""
    here = Path(__file__).parent
    answer = subprocess.run([git, "-C", str(here), "rev-parse", "HEAD"], capture_output=True, text=True, check=False)
    return answer.stdout.strip()


# what a continued run may change: none of these alters a step that was already made
_FREE = ("steps", "decay_steps", "device", "threads", "workers", "checkpoint_minutes", "log_every")


def _same_settings(path: Path, settings: StageSettings) -> None:
    """Remember the settings of the folder; refuse to continue it under others."""
    record = SettingsRecord(path, type(settings), [f"optimiser.{name}" for name in _FREE])
    values = config.to_dict(settings)
    record.check(values, "give the same settings or another output folder")
    record.write(values)
