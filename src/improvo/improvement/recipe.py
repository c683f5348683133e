"""How a round trains: the stages of the recipes, their controls, and how many steps they take."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from improvo.frontend.weights_files import load_weights, save_weights
from improvo.improvement.reference import ReferencePart
from improvo.improvement.settings import HELD, METRIC, TRACKS, ImproveSettings
from improvo.labeling.store import DONE, read_records

if TYPE_CHECKING:
    from improvo.frontend.weights_files import DataSource
    from improvo.training.data.posed_sequence import PosedSequence

_FEWEST = 300  # steps, however short the training part is
_PART_WAY = "part-way"  # the stage that goes back towards the start
_WEIGHTS = "weights.safetensors"


@dataclass(frozen=True)
class TrainingJob:
    """All that one training depends on."""

    settings: ImproveSettings
    seed: int
    start: Path  # weights
    output: Path  # folder of the first stage; each later one has a folder of its name in it
    labels: Path  # label store of the training part, made with the start of this training
    reference: tuple[ReferencePart, ...]  # of the training part
    control: bool = False  # by homographies of the same frames alone
    steps: int = 0  # of the control; 0 for what the settings say
    data: tuple[DataSource, ...] = ()
    progress: bool = True
    first: Path | None = None  # weights that the loop began with, if other than `start`

    @property
    def weights(self) -> Path:
        """Where the last stage leaves its weights."""
        return self._folder(len(stages(self.settings)) - 1) / _WEIGHTS

    def of_stage(self, number: int) -> TrainingJob:
        """What one stage does: it starts from the weights of the one before it."""
        start = self._folder(number - 1) / _WEIGHTS if number else self.start
        return replace(self, start=start, output=self._folder(number))

    def _folder(self, number: int) -> Path:
        return self.output / stages(self.settings)[number] if number else self.output


Train = Callable[[TrainingJob], dict[str, Any]]


def stages(settings: ImproveSettings) -> tuple[str, ...]:
    """What a training does, one after the other, named as the recipes that do one of them alone."""
    if settings.recipe != HELD:
        return (settings.recipe,)
    part_way = min(settings.way, settings.later_way) < 1
    return (HELD, *((METRIC,) if settings.then_metric else ()), *((_PART_WAY,) if part_way else ()))


def train(job: TrainingJob) -> dict[str, Any]:
    """Train as the recipe says, stage after stage; the last row of metrics of all of them.

    Every stage goes on where it was stopped. One that has nothing left to do takes the time of looking.
    """
    trains = {HELD: _train_held, METRIC: _train_metric, TRACKS: _train_tracks}
    row: dict[str, Any] = {}
    for number, stage in enumerate(stages(job.settings)):
        part = job.of_stage(number)
        if stage == _PART_WAY:
            _go_back(part, job)
        else:
            row |= trains[stage](part)
    return row


def steps_of(settings: ImproveSettings, frames: int) -> int:
    """Steps of a training without a limit of time.

    Args:
        settings: of the loop.
        frames: of the training part.
    """
    if settings.recipe == METRIC:
        return settings.metric.pairs
    if settings.recipe != HELD:
        return settings.training.optimiser.steps
    most = settings.held.optimiser.steps
    return min(max(round(settings.steps_per_frame * frames), _FEWEST), most) if settings.steps_per_frame else most


def _train_held(job: TrainingJob) -> dict[str, Any]:
    from improvo.training.data.pictures import Pictures, Source
    from improvo.training.held_training import train_held

    settings = job.settings.held
    posed = _teaching(job, settings.longer_side)
    sources = [_source(entry, Source) for entry in posed]
    steps = job.steps or steps_of(job.settings, sum(len(part.frames) for part in job.reference if not part.earlier))
    optimiser = replace(settings.optimiser, steps=steps, seed=job.seed)
    pairs = replace(settings.pairs, two_frames=settings.pairs.two_frames and not job.control)
    has_head = load_weights(job.start).architecture.stability
    return train_held(
        Pictures(tuple(sources)),
        posed,
        replace(settings, optimiser=optimiser, pairs=pairs),
        job.output,
        job.start,
        job.start if has_head else None,
        job.data,
        job.progress,
        0.0 if job.control else 60 * job.settings.minutes,
        () if job.control or not _has_labels(job.labels) else (job.labels,),
    )


def _train_metric(job: TrainingJob) -> dict[str, Any]:
    from improvo.training.metric_training import train_metric
    from improvo.training.stages.descriptor_metric import NoDescriptorMapError

    settings = job.settings.metric
    settings = replace(settings, seed=job.seed, two_frames=settings.two_frames and not job.control)
    teaching = _teaching(job, settings.longer_side)
    try:
        return train_metric(teaching, settings, job.output, job.start, job.data)
    except NoDescriptorMapError:  # another stage may have learned all the same
        if job.settings.recipe == METRIC:
            raise
        weights = load_weights(job.start)
        save_weights(job.output / _WEIGHTS, weights.tensors, weights.card)
        return {}


def _go_back(part: TrainingJob, whole: TrainingJob) -> None:
    """Towards what the training began with, then, of a later round, towards what the loop began with."""
    from improvo.training.interpolated_weights import write_interpolated

    part.output.mkdir(exist_ok=True)
    ends = [(whole.start, part.settings.way)]
    if whole.first is not None:
        ends.append((whole.first, part.settings.later_way))
    write_interpolated(ends, part.start, part.output / _WEIGHTS)


def _teaching(job: TrainingJob, longer_side: int) -> list[PosedSequence]:
    """The frames of the reference with depth. At most half of the pairs that are drawn are of earlier runs."""
    new = [entry for part in job.reference if not part.earlier for entry in part.teaching_frames(longer_side)]
    replayed = [entry for part in job.reference if part.earlier for entry in part.teaching_frames(longer_side)]
    weight = min(len(new) / len(replayed), 1.0) if replayed else 1.0
    return [*new, *(replace(entry, weight=weight) for entry in replayed)]


def _has_labels(store: Path) -> bool:
    return store.is_dir() and any(record.state == DONE for record in read_records(store))


def _source(posed: PosedSequence, kind: Any) -> Any:
    """The same frames as single pictures, for homography pairs."""
    count = len(posed.pictures)
    return kind(posed.name, posed.pictures, ("",) * count, posed.weight * float(np.sqrt(count)), masks=posed.masks)


def _train_tracks(job: TrainingJob) -> dict[str, Any]:
    from improvo.training.odometry_training import train_odometry

    settings = job.settings.training
    steps = job.steps or settings.optimiser.steps
    pairs = replace(settings.pairs, same_frame_share=1.0) if job.control else settings.pairs
    settings = replace(settings, pairs=pairs, optimiser=replace(settings.optimiser, steps=steps, seed=job.seed))
    return train_odometry([job.labels], settings, job.output, job.start, job.data, job.progress)
