"""SuperPoint's two stages as verbs: from settings and pictures to a folder with weights, model card and metrics."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from improvo.errors import InputError
from improvo.frontend.runtime_torch import load_network
from improvo.frontend.weights_files import DataSource, load_weights
from improvo.training.batches.drawn_shapes import ShapeBatches, shape_source
from improvo.training.batches.homography_pairs import PairBatches
from improvo.training.data.homographic_adaptation import Detector, adapt, network_detector, shi_tomasi
from improvo.training.data.pictures import Pictures, load_pictures
from improvo.training.data.point_labels import PointLabels, load_labels, save_labels
from improvo.training.device import choose_device
from improvo.training.networks import first_network, published_architecture
from improvo.training.output_folder import model_card, not_stated, run_stage, stage_folder
from improvo.training.settings import HomographiesSettings, ShapesSettings
from improvo.training.stages.superpoint import JointStage, MagicPointStage

LABELS = "labels.npz"
SHAPES = DataSource("procedural shapes", "Apache-2.0", "Drawn by improvo.training.data.shapes.")


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
        labels = adapted_labels(pictures, settings, output, detector, progress)
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


def adapted_labels(
    pictures: Pictures, settings: HomographiesSettings, output: Path, detector: Path | None, progress: bool
) -> list[list[PointLabels]]:
    """Labels of the pictures by homographic adaptation, made once and kept in the folder.

    Args:
        pictures: to label.
        settings: of the adaptation, its views and its seed.
        output: folder that the labels are kept in.
        detector: weights whose detector labels the pictures; None takes classical corners.
        progress: show it.

    Raises:
        InputError: no keypoint in any picture.
    """
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
