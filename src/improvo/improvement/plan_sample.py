"""What depth maps, steps of training and pairs of the validation cost here, measured on a labelled sample."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from improvo.errors import ImprovoError, installed
from improvo.improvement.estimate import Costs
from improvo.improvement.measuring import ScoreJob, scores_of
from improvo.improvement.recipe import TrainingJob, train
from improvo.improvement.reference import ReferencePart, make_depth
from improvo.improvement.settings import ImproveSettings
from improvo.jobs.processes import run_in_processes
from improvo.labeling.labeled import read_labels

_DEPTH_MAPS = 100  # fewer would have fewer neighbours each
_FEW_STEPS, _MORE_STEPS = 4, 24


@dataclass(frozen=True)
class _CostJob:
    """A sample to measure on."""

    store: Path  # of labels, within a folder that is removed afterwards
    weights: Path
    settings: ImproveSettings
    costs: Costs


def measure(store: Path, weights: Path, settings: ImproveSettings, usual: Costs) -> Costs | None:
    """Processor seconds on one core; None where they cannot be measured, for want of torch or of depth.

    Args:
        store: labels of a sample, made with the weights; its folder is written to.
        weights: of the network at the start.
        settings: of the loop.
        usual: what is not measured is taken from it.
    """
    if not installed("torch"):
        return None
    found: list[Costs | Exception] = []
    job = _CostJob(store, weights, settings, usual)
    run_in_processes(_measured, [job], lambda _, result: found.append(result), lambda count: None, 1)
    return found[0] if isinstance(found[0], Costs) else None


def _measured(job: _CostJob, tick: Callable[[], None]) -> Costs:
    """In a process of its own, so that its memory is given back."""
    labeled = max(read_labels(job.store), key=lambda sequence: sequence.record.tracked)
    posed = np.flatnonzero(labeled.frames.segment >= 0)[:_DEPTH_MAPS]
    part = ReferencePart(labeled.name, labeled, posed, job.store.parent / "depth.zip")
    maps = 0

    def count() -> None:
        nonlocal maps
        maps += 1

    begun = _processor_seconds()
    make_depth(part, len(posed), job.settings.reference, count)
    depth = (_processor_seconds() - begun) / max(maps, 1)
    first = _training_seconds(job, part, _FEW_STEPS)  # with what a process does once: loading torch, compiling
    few, more = (_training_seconds(job, part, steps) for steps in (_FEW_STEPS, _MORE_STEPS))
    step = max(more - few, 0.0) / (_MORE_STEPS - _FEW_STEPS)
    start = max(first - _FEW_STEPS * step, 0.0)
    return replace(job.costs, depth=depth, step=step, start=start, pair=_of_pair(job, part))


def _training_seconds(job: _CostJob, part: ReferencePart, steps: int) -> float:
    """Of a whole training with so many steps."""
    settings = replace(
        job.settings,
        minutes=0.0,
        held=replace(job.settings.held, optimiser=replace(job.settings.held.optimiser, steps=steps, decay_steps=1)),
        training=replace(
            job.settings.training, optimiser=replace(job.settings.training.optimiser, steps=steps, decay_steps=1)
        ),
        steps_per_frame=0.0,
        then_metric=False,  # its cost is that of the features
    )
    begun = _processor_seconds()
    with tempfile.TemporaryDirectory(dir=job.store.parent) as output:
        train(TrainingJob(settings, 0, job.weights, Path(output), job.store, (part,), progress=False))
    return _processor_seconds() - begun


def _of_pair(job: _CostJob, part: ReferencePart) -> float:
    """The usual cost where the sample is too short for a pair."""
    begun, pairs = _processor_seconds(), 0

    def count() -> None:
        nonlocal pairs
        pairs += 1

    try:
        scores_of(ScoreJob(part, job.weights, job.settings.validation), count)
    except ImprovoError:
        return job.costs.pair
    return (_processor_seconds() - begun) / pairs if pairs else job.costs.pair


def _processor_seconds() -> float:
    """Of this process and those that it has waited for."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system
