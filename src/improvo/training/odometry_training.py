"""VO adaptation as a verb (paper, "Training Details"): from label stores to a folder with weights and their card."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from improvo.continuation import SettingsRecord
from improvo.errors import InputError
from improvo.frontend.channel_pruning import without_dead_channels
from improvo.frontend.weights_files import DataSource, load_weights
from improvo.training.batches.homography_pairs import PairBatches
from improvo.training.data.pictures import load_pictures
from improvo.training.networks import started_network
from improvo.training.output_folder import model_card, not_stated, run_stage, stage_folder
from improvo.training.settings import HomographiesSettings, OdometryTrainingSettings
from improvo.training.superpoint_training import adapted_labels

if TYPE_CHECKING:
    from improvo.labeling.labeled import LabeledSequence

LABEL_STORES = "label-stores.json"


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
    from improvo.training.batches.tracked_pairs import TrackedPairs
    from improvo.training.data.label_library import LabelLibrary
    from improvo.training.stages.vo_adaptation import VOAdaptationStage

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
    labels = adapted_labels(pictures, as_before, output, None, progress)
    return PairBatches(pictures, labels, as_before), [source.name for source in pictures.sources]


def _same_labels(path: Path, sequences: Sequence[LabeledSequence]) -> None:
    """Remember what a folder is trained on; refuse to continue it with other labels."""
    now = [[s.name, s.record.frames, s.record.tracks, s.record.stable, s.record.unstable] for s in sequences]
    record = SettingsRecord(path)
    if record.difference(now):
        raise InputError(f"{path.parent}: was begun with other labels; give the same stores or another output folder")
    record.write(now)
