"""The steps of the loop. Each leaves a finished file or folder, and does nothing where that is there already."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from improvo.errors import InputError, OutputError
from improvo.frontend.weights import load_weights, save_weights
from improvo.improvement.candidate import Candidate, calibration_images, write_calibrated
from improvo.improvement.held_back import Part, Split, last_part, named, remembered, share_labels, whole_sequences
from improvo.improvement.judge import judge
from improvo.improvement.judgement import Judgement, read_judgement
from improvo.improvement.settings import ImproveSettings
from improvo.improvement.telling import Telling
from improvo.improvement.workspace import Workspace
from improvo.labeling.label_sequences import label_sequences
from improvo.labeling.store import DONE, SequenceRecord, read_records
from improvo.sequences import SequenceSettings, open_sequence
from improvo.training.settings import OdometryTrainingSettings

if TYPE_CHECKING:
    from improvo.frontend.weights import DataSource


class Train(Protocol):
    """What teaches; `improvo.training.stages.train_odometry`."""

    def __call__(
        self,
        labels: Sequence[Path],
        settings: OdometryTrainingSettings,
        output: Path,
        start: Path,
        data: tuple[DataSource, ...] = (),
        progress: bool = True,
    ) -> dict[str, Any]: ...


class Steps:
    """The steps, with what they all need.

    Args:
        workspace: the output folder.
        settings: of the loop.
        train: what teaches.
        data: what the model card says about the recordings.
        workers: sequences that are labelled at a time.
        ray: address of a Ray cluster that labels them, see `improvo.jobs.on_ray`.
        telling: shows progress and results.
    """

    def __init__(
        self,
        workspace: Workspace,
        settings: ImproveSettings,
        train: Train,
        data: tuple[DataSource, ...],
        workers: int | None,
        ray: str | None,
        telling: Telling,
    ) -> None:
        self._workspace, self._settings, self._train = workspace, settings, train
        self._data, self._workers, self._ray, self._telling = data, workers, ray, telling

    def hold_back(self, sequences: Sequence[Path], evaluate: Sequence[Path], start: Path) -> Split:
        """What is trained on and what is held back; several sequences are labelled first, to know which are of use."""
        how, share = self._settings.sequence, self._settings.held_back.share

        def choose() -> Split:
            if evaluate:
                return named(sequences, evaluate, how)
            return last_part(sequences[0], how, share) if len(sequences) == 1 else self._survey(sequences, start)

        split = remembered(self._workspace.split, choose)
        shutil.rmtree(self._workspace.survey, ignore_errors=True)
        return split

    def begin(self, start: Path, part: Part) -> Candidate:
        """The candidate at the start: weights as given; where int8 lacks their activation ranges, those are added."""
        candidate = self._workspace.start
        if not candidate.weights.is_file():
            candidate.folder.mkdir(exist_ok=True)
            weights = load_weights(start)
            if weights.card.activation_ranges:
                save_weights(candidate.weights, weights.tensors, weights.card)
            else:
                write_calibrated(start, candidate.weights, calibration_images(part, self._images))
        return candidate

    def label(self, teacher: Candidate, part: Part) -> list[SequenceRecord]:
        """Stability labels of the training part, made with the teacher."""
        return self._label(teacher, list(part.paths), part.sequence, teacher.labels, "training part")

    def learn(self, candidate: Candidate, number: int, teacher: Candidate, part: Part) -> None:
        """The candidate of a round: the teacher's weights, trained on the teacher's labels."""
        if candidate.weights.is_file():
            return
        candidate.folder.mkdir(exist_ok=True)
        optimiser = self._settings.training.optimiser
        # another try from the same weights and labels must not be the same try
        settings = replace(self._settings.training, optimiser=replace(optimiser, seed=optimiser.seed + number - 1))
        progress = self._telling.progress
        self._train([teacher.labels], settings, candidate.training, teacher.weights, self._data, progress=progress)
        images = calibration_images(part, self._images)
        write_calibrated(candidate.training / "weights.safetensors", candidate.weights, images)

    def judge(self, candidate: Candidate, part: Part) -> Judgement:
        """How good a candidate is on what was held back."""
        if candidate.judgement.is_file():
            return read_judgement(candidate.judgement)
        try:
            records = self._label(candidate, list(part.paths), part.sequence, candidate.held_back, "held back")
        except InputError:  # none of it: the matches can be judged all the same
            records = _refuse_unwritten(read_records(candidate.held_back))
            if not records:
                raise
        with self._telling.bar(f"{candidate.name}, surviving matches", "pair") as tick:
            return judge(candidate, part, records, self._settings.judge, tick, self._telling.progress)

    @property
    def _images(self) -> int:
        return self._settings.judge.calibration_images

    def _survey(self, sequences: Sequence[Path], start: Path) -> Split:
        """Label all sequences whole, then hold back some of those that have labels."""
        settings = self._settings
        candidate = self.begin(start, _readable_beginning(sequences, settings.sequence, settings.held_back.share))
        store = self._workspace.survey
        records = self._label(candidate, list(sequences), settings.sequence, store, "all sequences")
        split = whole_sequences(records, settings.sequence, settings.held_back.share)
        if sum(record.state == DONE for record in records) > 1:
            share_labels(store, records, split.training, candidate.labels)
            share_labels(store, records, split.held_back, candidate.held_back)
        return split

    def _label(
        self, candidate: Candidate, paths: list[Path], how: SequenceSettings, store: Path, what: str
    ) -> list[SequenceRecord]:
        frontend = replace(self._settings.frontend, name=str(candidate.weights))
        what = f"labels by {candidate.name}, {what}"
        with self._telling.bar(what, "frame", sum(_length(path, how) for path in paths) or None) as tick:
            records = label_sequences(
                paths,
                store,
                self._settings.run_settings(how, frontend),
                workers=self._workers,
                ray=self._ray,
                on_record=lambda record: self._telling.record(what, record),
                on_frames=tick,
            )
        return _refuse_unwritten(records)


def _length(path: Path, how: SequenceSettings) -> int:
    """Frames to come, for the progress bar."""
    with suppress(InputError):
        return open_sequence(path, how).length or 0
    return 0


def _refuse_unwritten(records: list[SequenceRecord]) -> list[SequenceRecord]:
    """The records, if none of them says that its labels could not be written.

    Raises:
        OutputError: a full disk; to go on without those labels would give other weights.
    """
    signs = ("cannot be written", *map(os.strerror, (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)))
    for record in records:
        if record.state != DONE and any(sign in record.reason for sign in signs):
            raise OutputError(f"{record.reason.partition(';')[0]}; make room, and run again to go on from here")
    return records


def _readable_beginning(sequences: Sequence[Path], how: SequenceSettings, share: float) -> Part:
    """Frames that will never be held back, whichever sequences are: the beginning of the first that can be read.

    Raises:
        InputError: none can be read.
    """
    for path in sequences[:-1]:
        with suppress(InputError):
            return last_part(path, how, share).training
    return last_part(sequences[-1], how, share).training
