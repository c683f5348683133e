"""Self-improvement, the paper's title: label video with a frontend, train it with the labels, keep it if it is better.

A run that was stopped, in whatever way, goes on when it is started again: every step leaves a finished file or folder
and is skipped where that is there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from improvo.errors import ConfigError
from improvo.files import make_output_folder
from improvo.folder_lock import locked
from improvo.frontend.weights_files import load_weights, save_weights
from improvo.improvement.decision import rule, why_not_better
from improvo.improvement.earlier import earlier_runs
from improvo.improvement.estimate import refuse_full_disk
from improvo.improvement.folder import COMMAND, Candidate, ImproveFolder
from improvo.improvement.plan import first_estimate
from improvo.improvement.progress import ImprovementProgress
from improvo.improvement.recipe import Train, TrainingJob
from improvo.improvement.reference import HELD_BACK, TRAINING, ReferencePart
from improvo.improvement.report import write_report
from improvo.improvement.rounds import Rounds
from improvo.improvement.settings import ImproveSettings
from improvo.improvement.split import Split
from improvo.improvement.validation import Validation, summary
from improvo.sequences.given_files import with_absolute_files
from improvo.terminal import counted

if TYPE_CHECKING:
    from improvo.frontend.weights_files import DataSource


@dataclass(frozen=True)
class Improvement:
    """What the loop found."""

    weights: Path  # of the best frontend, which is the one at the start if no round was better
    best: int  # its row in the following
    candidates: tuple[Candidate, ...]  # the first is the start
    validations: tuple[Validation, ...]
    faults: tuple[str, ...]  # what each lacks to be better than all before it, in words; empty where it is
    control: tuple[Candidate, Validation] | None = None  # the start, trained by homographies alone, as many rounds

    @property
    def kept(self) -> tuple[int, ...]:
        """The rounds that were better than all before them, of which the best is made."""
        return tuple(number for number, faults in enumerate(self.faults) if number > 0 and not faults)


def improve(
    sequences: Sequence[Path],
    output: Path,
    settings: ImproveSettings,
    rounds: int | None = None,
    evaluate: Sequence[Path] = (),
    workers: int | None = None,
    ray: str | None = None,
    data: tuple[DataSource, ...] = (),
    progress: ImprovementProgress | None = None,
    train: Train | None = None,
    after: Path | None = None,
) -> Improvement:
    """Improve a frontend on recordings without ground truth.

    Args:
        sequences: the recordings; part of them is held back and never trained on.
        output: folder of the result; an unfinished one is continued.
        settings: all of them; `settings.frontend.name` is where the loop starts.
        rounds: of training and validation, each from the best weights before it. By default they end with the first
            that is not better, and after those of `improvo.improvement.plan.usual_rounds`.
        evaluate: recordings to hold back; without any, some of `sequences`, or the last part of a single one.
        workers: sequences labelled at a time, a process with one core for each; by default one, in this process.
        ray: address of a Ray cluster that labels them, see `improvo.jobs.on_ray`.
        data: what the model card says about the recordings.
        progress: is told progress and results.
        train: in place of `improvo.improvement.recipe.train`.
        after: finished folder of this loop. Recordings that it had are replayed and must not get worse; the others are
            new. It starts from that folder's weights, unless the settings name a frontend other than the default.

    Raises:
        InputError: nothing could be labelled, weights that cannot be read, or a recording of `evaluate` that a folder
            before this one was trained on.
        ConfigError: the folder was begun with other settings.
        OutputError: the folder is not ours, another process is at work there, or it cannot be written (full disk).
    """
    progress = progress or ImprovementProgress()
    earlier = earlier_runs(after)
    if output.resolve() in earlier.folders:
        raise ConfigError(f"{output}: cannot follow itself; choose another output folder")
    sequences = earlier.without_known(sequences)
    earlier.refuse_taught(evaluate)
    settings = replace(settings, sequence=with_absolute_files(settings.sequence))
    first_weights = earlier.first_weights(settings.frontend.name)
    make_output_folder(output, COMMAND)
    with locked(output):
        most, needed = first_estimate(sequences, settings, rounds, evaluate)
        if needed is not None:
            progress.line(f"estimate: {needed.words}, {'' if rounds else 'up to '}{counted(most, 'round')}")
            refuse_full_disk(output, needed)  # before the settings are recorded, which fewer steps would contradict
        folder = ImproveFolder(output, sequences, evaluate, settings, first_weights, after)
        loop = Rounds(folder, settings, train or _train, data, workers, ray, progress)
        split = loop.split(sequences, evaluate, first_weights)
        progress.split(split)
        start = loop.start(first_weights, split.training)
        replayed, judged_before = earlier.parts(TRAINING), earlier.parts(HELD_BACK)
        new_teaching, new_judging = loop.reference(split)
        teaching, judging = new_teaching + replayed, new_judging + judged_before
        result = Improvement(folder.weights, 0, (start,), (loop.validate(start, split.held_back, judging),), ("",))
        progress.validated(start, result.validations[0], result.validations[0], settings.validation)
        _keep(result, folder, split, settings)
        for number in range(1, max(most, folder.finished_rounds()) + 1):
            if rounds is None and number > folder.finished_rounds() and result.best < number - 1:
                progress.line(f"no further round, since the last was not better; --rounds {number} tries once more")
                break
            teacher = result.candidates[result.best]
            candidate = folder.round(number)
            if not candidate.validation.is_file():
                if settings.teaches_labels:
                    loop.label(teacher, split.training)
                loop.train(candidate, number, teacher, split.training, teaching)
            validation = loop.validate(candidate, split.held_back, judging)
            best, start_values = result.validations[result.best], result.validations[0]
            faults = why_not_better(validation, best, start_values, settings.validation)
            progress.validated(candidate, validation, start_values, settings.validation, faults)
            result = replace(
                result,
                best=result.best if faults else number,
                candidates=(*result.candidates, candidate),
                validations=(*result.validations, validation),
                faults=(*result.faults, faults),
            )
            _keep(result, folder, split, settings)
        if settings.control:
            control = _control(loop, folder, result, split, (teaching, judging))
            progress.validated(*control, result.validations[0], settings.validation)
            result = replace(result, control=control)
            _keep(result, folder, split, settings)
        return result


def _control(
    loop: Rounds,
    folder: ImproveFolder,
    result: Improvement,
    split: Split,
    reference: tuple[list[ReferencePart], list[ReferencePart]],
) -> tuple[Candidate, Validation]:
    """What as many rounds of as many steps as the best is made of give by homographies of the same frames alone.

    Where no round was better it is one, as the first was.
    """
    control = result.candidates[0]
    for number, of_round in enumerate(result.kept or (1,), 1):
        teacher, control = control, folder.control(number)
        steps = int(load_weights(result.candidates[of_round].weights).card.training.get("steps", 0))
        loop.train(control, number, teacher, split.training, reference[0], steps)
    return control, loop.validate(control, split.held_back, reference[1])


def _keep(result: Improvement, folder: ImproveFolder, split: Split, settings: ImproveSettings) -> None:
    """Leave the best weights and the report of this round, unless an earlier run has left those of a later one."""
    if len(result.candidates) <= folder.finished_rounds():
        return
    best, validation = result.candidates[result.best], result.validations[result.best]
    measures = summary(validation, result.validations[0], settings.validation)
    words = rule(settings.validation, bool(result.validations[0].earlier))
    _publish(best, folder.weights, words, measures)
    judged = result.candidates, result.validations, result.faults
    write_report(folder.report, *judged, result.best, split, settings, result.control)


def _publish(best: Candidate, target: Path, words: str, measures: dict[str, float]) -> None:
    """Put the weights of a candidate where the user looks for them, with what was measured of them in their card.

    A file that says so already is left alone.
    """
    weights = load_weights(best.weights)
    metrics = {**weights.card.metrics, "improvement": {"kept": best.name, "rule": words, **measures}}
    card = replace(weights.card, metrics=metrics)
    if target.is_file() and target.with_suffix(".json").is_file():
        written = load_weights(target)
        if written.card == card and all(np.array_equal(written.tensors[k], v) for k, v in weights.tensors.items()):
            return
    save_weights(target, weights.tensors, card)


def _train(job: TrainingJob) -> dict[str, Any]:
    from improvo.improvement.recipe import train

    return train(job)
