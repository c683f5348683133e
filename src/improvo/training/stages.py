"""The training stages as verbs: from settings and pictures to a folder with weights, model card and metrics."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from improvo.continuation import SettingsRecord
from improvo.errors import InputError
from improvo.frontend.channel_pruning import without_dead_channels
from improvo.frontend.runtime_torch import load_network
from improvo.frontend.weights import DataSource, load_weights
from improvo.training.adaptation import Detector, adapt, network_detector, shi_tomasi
from improvo.training.labels import PointLabels, load_labels, save_labels
from improvo.training.networks import first_network, published_architecture, started_network
from improvo.training.pairs import PairBatches
from improvo.training.pictures import Pictures, load_pictures
from improvo.training.settings import HomographiesSettings, OdometryTrainingSettings, ShapesSettings
from improvo.training.stage_folder import model_card, not_stated, run_stage, stage_folder
from improvo.training.superpoint_stages import JointStage, MagicPointStage
from improvo.training.synthetic import ShapeBatches, shape_source
from improvo.training.trainer import choose_device

if TYPE_CHECKING:
    from improvo.labeling.labeled import LabeledSequence

LABELS = "labels.npz"
LABEL_STORES = "label-stores.json"
SHAPES = DataSource("procedural shapes", "Apache-2.0", "Drawn by improvo.training.shapes.")


def train_shapes(
    settings: ShapesSettings, output: Path, start: Path | None = None, progress: bool = True
) -> dict[str, Any]:
    """Stage 1: a detector from drawn shapes alone.

    Args:
        settings: all numbers.
        output: folder of the result; an unfinished one is continued.
        start: weights to start from; None starts from random ones.
        progress: show it.

    Returns:
        The last row of metrics.
    """
    network = first_network(settings.architecture, settings.optimiser.seed, start)
    card = model_card(published_architecture(settings.architecture), "shapes", settings, (SHAPES,), start)
    stage = MagicPointStage(network, settings.detector)
    return run_stage(stage, ShapeBatches(settings), settings, output, card, progress)


def train_homographies(
    sources: Sequence[str],
    settings: HomographiesSettings,
    output: Path,
    start: Path | None = None,
    detector: Path | None = None,
    data: tuple[DataSource, ...] = (),
    progress: bool = True,
    on_pictures: Callable[[Pictures], None] = lambda pictures: None,
) -> dict[str, Any]:
    """Stage 2: homographic adaptation of the pictures, then detector and descriptor together.

    Args:
        sources: see `load_pictures`.
        settings: all numbers.
        output: folder of the result; an unfinished one is continued.
        start: weights to start from; None starts from random ones.
        detector: weights whose detector labels the pictures; None takes classical corners.
        data: what the model card says about the pictures; the sources' names where it is empty.
        progress: show it.
        on_pictures: is told what was read, and what could not be.

    Returns:
        The last row of metrics.

    Raises:
        InputError: a source without a readable picture, or pictures without any keypoint.
    """
    pictures = load_pictures(sources, settings.longer_side, progress)
    on_pictures(pictures)
    seed = settings.optimiser.seed
    network = first_network(settings.architecture, seed, start, settings.stem_channels)
    with stage_folder(output, "homographies"):
        labels = _labels(pictures, settings, output, detector, progress)
        if not data:
            data = not_stated(source.name for source in pictures.sources)
        if settings.shapes:
            weight = settings.shapes_share / (1 - settings.shapes_share) * sum(s.weight for s in pictures.sources)
            source, drawn = shape_source(settings.shapes, seed, weight)
            pictures = replace(pictures, sources=(*pictures.sources, source))
            labels, data = [*labels, drawn], (*data, SHAPES)
        architecture = published_architecture(settings.architecture)
        card = model_card(architecture, "homographies", settings, data, start)
        card.training.update(
            detector_labels=detector.name if detector else "shi-tomasi",
            pictures=len(pictures),
            pictures_skipped=len(pictures.skipped),
        )
        batches = PairBatches(pictures, labels, settings)
        return run_stage(JointStage(network, settings), batches, settings, output, card, progress)


def train_odometry(
    labels: Sequence[Path],
    settings: OdometryTrainingSettings,
    output: Path,
    start: Path,
    data: tuple[DataSource, ...] = (),
    progress: bool = True,
    pictures: Sequence[str] = (),
) -> dict[str, Any]:
    """Stage 3: VO adaptation (paper, "Training Details").

    Args:
        labels: label stores, as `improvo label` makes them; all their finished sequences are trained on.
        settings: all numbers.
        output: folder of the result; an unfinished one is continued.
        start: weights to start from; the stability head starts from random ones where they have none.
        data: what the model card says about the recordings; their names where it is empty.
        progress: show it.
        pictures: sources (`load_pictures`) of the homography pairs that are replayed beside the labeled video.

    Returns:
        The last row of metrics.

    Raises:
        InputError: no store, a store whose labels have changed since the folder was begun, or no frame with enough
            stable points.
    """
    from improvo.labeling.labeled import read_labels
    from improvo.training.label_library import LabelLibrary
    from improvo.training.tracked_pairs import TrackedPairs
    from improvo.training.vo_adaptation import VOAdaptationStage

    sequences = [sequence for folder in labels for sequence in read_labels(folder)]
    with stage_folder(output, "odometry"):
        _same_labels(output / LABEL_STORES, sequences)
        parent = load_weights(start)
        architecture = replace(without_dead_channels(parent).architecture, stability=True)
        network = started_network(architecture, settings.optimiser.seed, parent)
        frames = LabelLibrary(
            sequences, settings.longer_side, settings.landmarks, output, settings.memory_mib,
            settings.optimiser.workers, progress,
        )  # fmt: skip
        replay, sources = _replay(pictures, settings, output, progress)
        pairs = TrackedPairs(frames, settings, replay)
        if not pairs.useful_frames:
            least = settings.pairs.least_points
            raise InputError(
                f"{labels[0]}: no frame has {least} stable points; label more or livelier video, or lower "
                "pairs.least_points"
            )
        if not data:
            data = not_stated((*(s.name for s in sequences), *sources))
        published = replace(parent.architecture, stability=True)
        card = model_card(published, "odometry", settings, data, start)
        card.training.update(
            stability_trained=True,
            sequences=len(sequences),
            frames=sum(sequence.record.frames for sequence in sequences),
            stable=sum(sequence.record.stable for sequence in sequences),
            unstable=sum(sequence.record.unstable for sequence in sequences),
        )
        balance = pairs.stable_per_unstable if settings.stability_balanced else None
        stage = VOAdaptationStage(network, settings, balance)
        return run_stage(stage, pairs, settings, output, replace(card, notes=""), progress)


def _replay(
    sources: Sequence[str], settings: OdometryTrainingSettings, output: Path, progress: bool
) -> tuple[PairBatches | None, list[str]]:
    """Homography pairs of pictures, labeled by corners as in stage 2, and the names of their sources."""
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
        detect = network_detector(load_network(weights), choose_device(settings.optimiser.device), settings.adaptation)
    labels = adapt(pictures, detect, settings.adaptation, settings.views, settings.optimiser.seed, progress)
    if not sum(len(picture.points) for source in labels for picture in source):
        raise InputError("homographic adaptation found no keypoint in any picture; the detector has learned nothing")
    save_labels(path, labels)
    return labels
