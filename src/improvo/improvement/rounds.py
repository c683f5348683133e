"""The steps of a round. Each leaves a finished file or folder, and does nothing where that is there already."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from improvo.errors import ConfigError, InputError, OutputError
from improvo.frontend.weights import find_weights, load_weights, save_weights
from improvo.improvement.folder import Candidate, ImproveFolder
from improvo.improvement.progress import ImprovementProgress
from improvo.improvement.settings import ImproveSettings
from improvo.improvement.split import (
    Part,
    Split,
    remembered_split,
    share_labels,
    split_as_named,
    split_last_part,
    split_whole_sequences,
)
from improvo.improvement.validation import Validation, read_validation, validate
from improvo.labeling.label_sequences import label_sequences
from improvo.labeling.store import DONE, SequenceRecord, read_records
from improvo.sequences import Sequence as ImageSequence
from improvo.sequences import SequenceSettings, open_sequence
from improvo.training.settings import OdometryTrainingSettings
from improvo.types import UInt8

if TYPE_CHECKING:
    from improvo.frontend.weights import DataSource


class Train(Protocol):
    """What trains; `improvo.training.stages.train_odometry`."""

    def __call__(
        self,
        labels: Sequence[Path],
        settings: OdometryTrainingSettings,
        output: Path,
        start: Path,
        data: tuple[DataSource, ...] = (),
        progress: bool = True,
    ) -> dict[str, Any]: ...


class Rounds:
    """The steps, with what they all need.

    Args:
        folder: the output folder.
        settings: of the loop.
        train: what trains.
        data: what the model card says about the recordings.
        workers: sequences that are labelled at a time.
        ray: address of a Ray cluster that labels them, see `improvo.jobs.on_ray`.
        progress: is told progress and results.
    """

    def __init__(
        self,
        folder: ImproveFolder,
        settings: ImproveSettings,
        train: Train,
        data: tuple[DataSource, ...],
        workers: int | None,
        ray: str | None,
        progress: ImprovementProgress,
    ) -> None:
        self._folder, self._settings, self._train = folder, settings, train
        self._data, self._workers, self._ray, self._progress = data, workers, ray, progress

    def split(self, sequences: Sequence[Path], evaluate: Sequence[Path], weights_file: Path) -> Split:
        """What is trained on and what is held back; several sequences are labelled first, to know which are of use.

        Args:
            sequences: all recordings.
            evaluate: those of them, or others, that the user wants to be held back; may be none.
            weights_file: of the frontend that labels several sequences.
        """
        how, share = self._settings.sequence, self._settings.split.share

        def choose() -> Split:
            if evaluate:
                return split_as_named(sequences, evaluate, how)
            return (
                split_last_part(sequences[0], how, share)
                if len(sequences) == 1
                else self._survey(sequences, weights_file)
            )

        split = remembered_split(self._folder.split, choose)
        shutil.rmtree(self._folder.survey, ignore_errors=True)
        return split

    def start(self, weights_file: Path, part: Part) -> Candidate:
        """The candidate at the start: weights as given; where int8 lacks their activation ranges, those are added."""
        candidate = self._folder.start
        if not candidate.weights.is_file():
            candidate.folder.mkdir(exist_ok=True)
            weights = load_weights(weights_file)
            if weights.card.activation_ranges:
                save_weights(candidate.weights, weights.tensors, weights.card)
            else:
                write_calibrated(weights_file, candidate.weights, calibration_images(part, self._images))
        return candidate

    def label(self, teacher: Candidate, part: Part) -> list[SequenceRecord]:
        """Stability labels of the training part, made with the teacher."""
        return self._label(teacher, list(part.paths), part.sequence, teacher.labels, "training part")

    def train(self, candidate: Candidate, number: int, teacher: Candidate, part: Part) -> None:
        """The candidate of a round: the teacher's weights, trained on the teacher's labels.

        Args:
            candidate: of the round; nothing is done where its weights are there already.
            number: of the round, from 1.
            teacher: the best candidate before it.
            part: the training part.
        """
        if candidate.weights.is_file():
            return
        candidate.folder.mkdir(exist_ok=True)
        optimiser = self._settings.training.optimiser
        # another try from the same weights and labels must not be the same try
        settings = replace(self._settings.training, optimiser=replace(optimiser, seed=optimiser.seed + number - 1))
        shown = self._progress.shown
        self._train([teacher.labels], settings, candidate.training, teacher.weights, self._data, progress=shown)
        images = calibration_images(part, self._images)
        write_calibrated(candidate.training / "weights.safetensors", candidate.weights, images)

    def validate(self, candidate: Candidate, part: Part) -> Validation:
        """How good a candidate is on what was held back."""
        if candidate.validation.is_file():
            return read_validation(candidate.validation)
        try:
            records = self._label(candidate, list(part.paths), part.sequence, candidate.held_back, "held back")
        except InputError:  # none of it: the matches can be measured all the same
            records = _refuse_unwritten(read_records(candidate.held_back))
            if not records:
                raise
        with self._progress.bar(f"{candidate.name}, surviving matches", "pair") as tick:
            return validate(candidate, part, records, self._settings.validation, tick, self._progress.shown)

    @property
    def _images(self) -> int:
        return self._settings.validation.calibration_images

    def _survey(self, sequences: Sequence[Path], weights_file: Path) -> Split:
        """Label all sequences whole, then hold back some of those that have labels."""
        settings = self._settings
        candidate = self.start(weights_file, _readable_beginning(sequences, settings.sequence, settings.split.share))
        store = self._folder.survey
        records = self._label(candidate, list(sequences), settings.sequence, store, "all sequences")
        split = split_whole_sequences(records, settings.sequence, settings.split.share)
        if sum(record.state == DONE for record in records) > 1:
            share_labels(store, records, split.training, candidate.labels)
            share_labels(store, records, split.held_back, candidate.held_back)
        return split

    def _label(
        self, candidate: Candidate, paths: list[Path], how: SequenceSettings, store: Path, what: str
    ) -> list[SequenceRecord]:
        frontend = replace(self._settings.frontend, name=str(candidate.weights))
        what = f"labels by {candidate.name}, {what}"
        with self._progress.bar(what, "frame", sum(_length(path, how) for path in paths) or None) as tick:
            records = label_sequences(
                paths,
                store,
                self._settings.run_settings(how, frontend),
                workers=self._workers,
                ray=self._ray,
                on_record=lambda record: self._progress.labeled(what, record),
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
            return split_last_part(path, how, share).training
    return split_last_part(sequences[-1], how, share).training


def starting_weights(name: str) -> Path:
    """The weights file that the loop starts from.

    Raises:
        ConfigError: a frontend that has no weights.
        InputError: no such file.
    """
    from improvo.frontend.registry import CLASSICAL

    if name in CLASSICAL:
        raise ConfigError(f"frontend {name}: has no weights to train; choose superpoint, superpoint-small or a file")
    return find_weights(name)


def write_calibrated(source: Path, target: Path, images: Sequence[UInt8]) -> None:
    """Copy weights with activation ranges over the images, so that they run in int8 where that can run them at all.

    Args:
        source: weights file.
        target: weights file to write.
        images: grey images (H, W).
    """
    from improvo.frontend.quantisation import calibrate

    weights = load_weights(source)
    if weights.architecture.normalisation != "after_relu":  # int8 has no negative activations
        weights = calibrate(weights, images)
    save_weights(target, weights.tensors, weights.card)


def calibration_images(part: Part, count: int) -> list[UInt8]:
    """About `count` frames, evenly spread over the recordings of the training part; unreadable ones are left out.

    Raises:
        InputError: there is none.
    """
    images = []
    for path in part.paths:
        try:
            sequence = open_sequence(path, part.sequence)
        except InputError:  # said when it is labelled
            continue
        wanted = max(1, round(count / len(part.paths)))
        rows = np.unique(np.linspace(0, len(sequence) - 1, wanted).round().astype(int))
        images += [image for row in rows if (image := _image(sequence, int(row))) is not None]
    if not images:
        raise InputError(f"{part.paths[0]}: none of its frames can be read; check the recording")
    return images


def _image(sequence: ImageSequence, row: int) -> UInt8 | None:
    try:
        return sequence[row].image
    except InputError:
        return None
