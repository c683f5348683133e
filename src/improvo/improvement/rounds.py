"""The steps of a round. Each leaves a finished file or folder, and does nothing where that is there already."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from improvo.errors import ConfigError, InputError, OutputError
from improvo.frontend.weights_files import find_weights, load_weights, save_weights
from improvo.improvement.folder import Candidate, ImproveFolder
from improvo.improvement.measuring import pairs_of, validate
from improvo.improvement.progress import ImprovementProgress
from improvo.improvement.recipe import Train, TrainingJob
from improvo.improvement.reference import (
    HELD_BACK,
    TRAINING,
    DepthJob,
    ReferencePart,
    do_depth_job,
    reference_parts,
    refuse_without_depth,
)
from improvo.improvement.settings import METRIC, TRACKS, ImproveSettings, SplitSettings
from improvo.improvement.split import (
    Part,
    Split,
    frames_there,
    remembered_split,
    share_labels,
    split_as_named,
    split_last_part,
    split_whole_sequences,
)
from improvo.improvement.validation import Validation, read_validation
from improvo.jobs.crew import Crew
from improvo.jobs.on_ray import gpus_of
from improvo.labeling.label_sequences import label_sequences
from improvo.labeling.store import DONE, SequenceRecord, read_records
from improvo.sequences import Sequence as ImageSequence
from improvo.sequences import SequenceSettings, open_sequence
from improvo.types import UInt8

if TYPE_CHECKING:
    from improvo.frontend.weights_files import DataSource


class Rounds:
    """The steps, with what they all need.

    Args:
        folder: the output folder.
        settings: of the loop.
        train: what trains.
        data: what the model card says about the recordings.
        workers: sequences that are labelled at a time, see `Crew`.
        ray: address of a Ray cluster that labels, measures and, where it has GPUs and this machine has none, trains.
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
        self._data, self._crew, self._progress = data, Crew(workers, ray), progress

    def split(self, sequences: Sequence[Path], evaluate: Sequence[Path], weights_file: Path) -> Split:
        """What is trained on and what is held back; several sequences are labelled first, to know which are of use.

        Args:
            sequences: all recordings.
            evaluate: those of them, or others, that the user wants to be held back; may be none.
            weights_file: of the frontend that labels several sequences.
        """
        how, settings = self._settings.sequence, self._settings.split

        def choose() -> Split:
            if evaluate:
                return split_as_named(sequences, evaluate, how)
            return (
                split_last_part(sequences[0], how, settings)
                if len(sequences) == 1
                else self._survey(sequences, weights_file)
            )

        return remembered_split(self._folder.split, choose)

    def start(self, weights_file: Path, part: Part) -> Candidate:
        """The candidate at the start: weights as given, with activation ranges of this video as every candidate has."""
        candidate = self._folder.start
        if not candidate.weights.is_file():
            candidate.folder.mkdir(exist_ok=True)
            write_calibrated(weights_file, candidate.weights, calibration_images(part, self._images))
        return candidate

    def reference(self, split: Split) -> tuple[list[ReferencePart], list[ReferencePart]]:
        """The fixed run over all frames, with depth of either part from its own frames: training, held back.

        Raises:
            InputError: one of the parts has no depth.
            OutputError: it cannot be written (full disk).
        """
        store, settings = self._folder.reference, self._settings.reference
        paths = list(dict.fromkeys(path.resolve() for path in (*split.training.paths, *split.held_back.paths)))
        done = {record.path for record in read_records(store) if record.state == DONE} if store.is_dir() else set()
        if not all(str(path) in done for path in paths):
            self._label(self._folder.start, paths, self._settings.sequence, store, "reference")
        found = []
        for kind, part, most in (
            (TRAINING, split.training, settings.most_training),
            (HELD_BACK, split.held_back, settings.most_held_back),
        ):
            parts = reference_parts(store, part, kind)
            missing = [one for one in parts if not one.depth_file.is_file()]
            jobs = [DepthJob(one, max(most // len(parts), 2), settings) for one in missing]
            with self._progress.bar(f"depth of the reference, {kind}", "frame") as tick:
                self._crew.results(do_depth_job, jobs, tick)
            found.append(parts)
        mend = "record longer, with a camera that moves sideways, or hold back other recordings with --evaluate"
        refuse_without_depth(found[0], "the training part", mend)
        more = ", or more of this one with --set split.share=0.5 and another -o" if len(paths) == 1 else ""
        refuse_without_depth(found[1], "what is held back", mend + more)
        return found[0], found[1]

    def label(self, teacher: Candidate, part: Part) -> list[SequenceRecord]:
        """Stability labels of the training part, made with the teacher."""
        self._share(teacher, part, teacher.labels)
        try:
            return self._label(teacher, list(part.paths), part.sequence, teacher.labels, "training part")
        except InputError:  # dense pairs teach without labels
            if self._settings.recipe == TRACKS:
                raise
            return _refuse_unwritten(read_records(teacher.labels))

    def train(
        self,
        candidate: Candidate,
        number: int,
        teacher: Candidate,
        part: Part,
        reference: Sequence[ReferencePart],
        steps: int = 0,
    ) -> None:
        """The candidate of a round: the teacher's weights, trained on.

        Args:
            candidate: of the round, or a control; nothing is done where its weights are there already.
            number: of the round, from 1.
            teacher: the best candidate before it, of a control the control of one round less.
            part: the training part.
            reference: of the training part.
            steps: of the control.
        """
        if candidate.weights.is_file():
            return
        candidate.folder.mkdir(exist_ok=True)
        settings = self._settings
        start = self._folder.start
        seeds = {TRACKS: settings.training.optimiser.seed, METRIC: settings.metric.seed}
        seed = seeds.get(settings.recipe, settings.held.optimiser.seed)
        job = TrainingJob(
            settings,
            seed + number - 1,  # another try from the same weights and labels must not be the same try
            teacher.weights,
            candidate.training,
            start.labels if candidate.is_control else teacher.labels,
            tuple(reference),
            control=candidate.is_control,
            steps=steps,
            data=self._data,
            progress=self._progress.shown,
            first=None if teacher == start else start.weights,
        )
        if self._trains_there():
            with self._progress.bar("training on the cluster", "step") as tick:
                self._crew.results(_TrainThere(self._train), [replace(job, progress=False)], tick, gpus=1)
        else:
            self._train(job)
        images = calibration_images(part, self._images)
        write_calibrated(job.weights, candidate.weights, images)

    def _trains_there(self) -> bool:
        """Whether the GPU is on the cluster, and not here."""
        settings = self._settings
        device = (settings.training if settings.recipe == TRACKS else settings.held).optimiser.device
        if self._crew.ray is None or device == "cpu":
            return False
        import torch

        return not torch.cuda.is_available() and gpus_of(self._crew.ray) > 0

    def validate(self, candidate: Candidate, part: Part, reference: Sequence[ReferencePart]) -> Validation:
        """How good a candidate is on what was held back."""
        if candidate.validation.is_file():
            return read_validation(candidate.validation)
        self._share(candidate, part, candidate.held_back)
        try:
            records = self._label(candidate, list(part.paths), part.sequence, candidate.held_back, "held back")
        except InputError:  # none of it: the matches can be measured all the same
            records = _refuse_unwritten(read_records(candidate.held_back))
            if not records:
                raise
        settings = self._settings.validation
        pairs = sum(len(pairs) for one in reference for pairs in pairs_of(one.fixed_run(), settings))
        with self._progress.bar(f"{candidate.name}, matches against the reference", "pair", pairs) as tick:
            return validate(candidate, part, reference, records, settings, tick, self._progress.shown, self._crew)

    def _share(self, candidate: Candidate, part: Part, store: Path) -> None:
        """Whole recordings were labelled by the start for the reference already."""
        reference = self._folder.reference
        if candidate != self._folder.start or part.sequence != self._settings.sequence or not reference.is_dir():
            return
        records = read_records(reference)
        done = {record.path for record in records if record.state == DONE}
        if all(str(path.resolve()) in done for path in part.paths):
            share_labels(reference, records, part, store)

    @property
    def _images(self) -> int:
        return self._settings.validation.calibration_images

    def _survey(self, sequences: Sequence[Path], weights_file: Path) -> Split:
        """Label all sequences whole, then hold back some of those that have labels."""
        settings = self._settings
        candidate = self.start(weights_file, _readable_beginning(sequences, settings.sequence, settings.split))
        records = self._label(candidate, list(sequences), settings.sequence, self._folder.reference, "all sequences")
        return split_whole_sequences(records, settings.sequence, settings.split)

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
                workers=self._crew.workers,
                ray=self._crew.ray,
                on_record=lambda record: self._progress.labeled(what, record),
                on_frames=tick,
            )
        return _refuse_unwritten(records)


@dataclass(frozen=True)
class _TrainThere:
    """Training as a job."""

    train: Train

    def __call__(self, job: TrainingJob, tick: Callable[[], None]) -> None:
        self.train(job)


def _length(path: Path, how: SequenceSettings) -> int:
    """Frames to come, for the progress bar."""
    with suppress(InputError):
        return frames_there(path, how)
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


def _readable_beginning(sequences: Sequence[Path], how: SequenceSettings, settings: SplitSettings) -> Part:
    """Frames that will never be held back, whichever sequences are: the beginning of the first that can be read.

    Raises:
        InputError: none can be read.
    """
    for path in sequences[:-1]:
        with suppress(InputError):
            return split_last_part(path, how, settings).training
    return split_last_part(sequences[-1], how, settings).training


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
        there = np.searchsorted(sequence.indices, sequence.present)
        rows = there[np.unique(np.linspace(0, len(there) - 1, wanted).round().astype(int))]
        images += [image for row in rows if (image := _image(sequence, int(row))) is not None]
    if not images:
        raise InputError(f"{part.paths[0]}: none of its frames can be read; check the recording")
    return images


def _image(sequence: ImageSequence, row: int) -> UInt8 | None:
    try:
        return sequence[row].image
    except InputError:
        return None
