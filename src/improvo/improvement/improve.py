"""Self-improvement, the paper's title: label video with a frontend, train it with the labels, keep it if it is better.

A run that was stopped, in whatever way, goes on when it is started again: every step leaves a finished file or folder
and is skipped where that is there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from improvo.improvement.candidate import Candidate, publish, starting_weights
from improvo.improvement.held_back import Split
from improvo.improvement.judgement import Judgement, is_better, rule, scores
from improvo.improvement.report import write_report
from improvo.improvement.settings import ImproveSettings
from improvo.improvement.steps import Steps, Train
from improvo.improvement.telling import Telling
from improvo.improvement.workspace import Workspace

if TYPE_CHECKING:
    from improvo.frontend.weights import DataSource


@dataclass(frozen=True)
class Improvement:
    """What the loop found."""

    weights: Path  # of the best frontend, which is the one at the start if no round was better
    best: int  # its row in the following
    candidates: tuple[Candidate, ...]  # the first is the start
    judgements: tuple[Judgement, ...]


def improve(
    sequences: Sequence[Path],
    output: Path,
    settings: ImproveSettings,
    rounds: int = 1,
    evaluate: Sequence[Path] = (),
    workers: int | None = None,
    ray: str | None = None,
    data: tuple[DataSource, ...] = (),
    telling: Telling | None = None,
    train: Train | None = None,
) -> Improvement:
    """Improve a frontend on recordings without ground truth.

    Args:
        sequences: the recordings; part of them is held back and never trained on.
        output: folder of the result; an unfinished one is continued.
        settings: all of them; `settings.frontend.name` is where the loop starts.
        rounds: of labelling, training and judging.
        evaluate: recordings to hold back; without any, some of `sequences`, or the last part of a single one.
        workers, ray: who labels many sequences, see `improvo.labeling.label_sequences.label_sequences`.
        data: what the model card says about the recordings.
        telling: shows progress and results.
        train: in place of `improvo.training.stages.train_odometry`.

    Raises:
        InputError: nothing could be labelled, or weights that cannot be read.
        ConfigError: the folder was begun with other settings.
        OutputError: the folder is not ours, or cannot be written (full disk).
    """
    telling = telling or Telling()
    first_weights = starting_weights(settings.frontend.name)
    workspace = Workspace(output, sequences, evaluate, settings, first_weights)
    steps = Steps(workspace, settings, train or _train_odometry, data, workers, ray, telling)

    split = steps.hold_back(sequences, evaluate, first_weights)
    telling.split(split)
    start = steps.begin(first_weights, split.training)
    result = Improvement(workspace.weights, 0, (start,), (steps.judge(start, split.held_back),))
    telling.judged(start, result.judgements[0], result.judgements[0], better=None)
    _keep(result, workspace, split, settings)
    for number in range(1, max(rounds, workspace.rounds_judged()) + 1):
        teacher = result.candidates[result.best]
        candidate = workspace.round(number)
        if not candidate.judgement.is_file():
            steps.label(teacher, split.training)
            steps.learn(candidate, number, teacher, split.training)
        judgement = steps.judge(candidate, split.held_back)
        better = is_better(judgement, result.judgements[result.best], settings.judge)
        telling.judged(candidate, judgement, result.judgements[0], better)
        result = Improvement(
            workspace.weights,
            number if better else result.best,
            (*result.candidates, candidate),
            (*result.judgements, judgement),
        )
        _keep(result, workspace, split, settings)
    return result


def _keep(result: Improvement, workspace: Workspace, split: Split, settings: ImproveSettings) -> None:
    """Leave the best weights and the report of this round, unless an earlier run has left those of a later one."""
    if len(result.candidates) <= workspace.rounds_judged():
        return
    best, judgement = result.candidates[result.best], result.judgements[result.best]
    publish(best, workspace.weights, rule(settings.judge), scores(judgement, result.judgements[0]))
    write_report(workspace.report, result.candidates, result.judgements, result.best, split, settings)


def _train_odometry(*arguments: Any, **options: Any) -> dict[str, Any]:
    from improvo.training.stages import train_odometry

    return train_odometry(*arguments, **options)
