"""All labeled sequences of a training, in bounded memory: opened when one is drawn, the last ones kept.

Training on 2.5 million frames holds some thousand bytes for each sequence and two for each frame, and beside that what
`memory_mib` allows.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from improvo.jobs.pool import Workers
from improvo.labeling.labeled import LabeledSequence
from improvo.training.data.labeled_frames import LabeledFrames
from improvo.training.data.landmark_files import LandmarkFiles
from improvo.training.data.landmarks import Summary
from improvo.training.distributed import Process
from improvo.training.settings import LandmarkSettings

SPARE = "landmarks"  # folder beside the weights, for label stores that cannot be written
_MIB = 1 << 20
_READER_BYTES = 4 * _MIB  # of what reads the pictures of a sequence, roughly: a row group of JPEGs, a decoder
_ENOUGH_FOR_PROCESSES = 8  # sequences for each; fewer are done before a process has started


class LabelLibrary(Sequence[LabeledFrames]):
    """The frames of every sequence; what is there for all of them is a `Summary`.

    A process that gets a copy begins with nothing open.

    Args:
        sequences: finished labels.
        longer_side, settings: see `LabeledFrames`.
        output: folder of the training.
        memory_mib: of the sequences that are open; one is, however large.
        workers: processes that make the landmark files that are missing.
        progress: show it.

    Raises:
        InputError: tables that are damaged.
        OutputError: no landmark file can be written.
    """

    def __init__(
        self,
        sequences: Sequence[LabeledSequence],
        longer_side: int,
        settings: LandmarkSettings,
        output: Path,
        memory_mib: int,
        workers: int = 1,
        progress: bool = False,
    ) -> None:
        self._sequences, self._longer_side, self._settings = sequences, longer_side, settings
        self._files = LandmarkFiles(settings, output / SPARE)
        self._most_bytes = memory_mib * _MIB
        self._open: OrderedDict[int, LabeledFrames] = OrderedDict()
        self.summaries = self._summaries(workers, progress)

    def __len__(self) -> int:
        return len(self._sequences)

    def __getitem__(self, row: Any) -> Any:
        """The frames of a sequence, opened if need be; those that were used longest ago are closed for it."""
        if row not in self._open:
            sequence = replace(self._sequences[row])  # what it reads goes when it is closed
            landmarks = self._files.landmarks(sequence)
            self._open[row] = LabeledFrames(sequence, self._longer_side, self._settings, landmarks)
        self._open.move_to_end(row)
        self._close_oldest()
        return self._open[row]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": OrderedDict()}

    def _close_oldest(self) -> None:
        held = sum(frames.landmarks.nbytes + _READER_BYTES for frames in self._open.values())
        while held > self._most_bytes and len(self._open) > 1:
            _, closed = self._open.popitem(last=False)
            held -= closed.landmarks.nbytes + _READER_BYTES

    def _summaries(self, workers: int, progress: bool) -> list[Summary]:
        """From the landmark files; those that are missing are made."""
        found: dict[int, Summary] = {}
        for row, sequence in enumerate(self._sequences):
            summary = self._files.summary(sequence)
            if summary is not None:
                found[row] = summary
        missing = [row for row in range(len(self)) if row not in found]
        process = Process.current()
        # processes that train together begin in different places, and find what others have made meanwhile
        first = process.rank * len(missing) // process.world_size
        tasks = [(self._files, self._sequences[row]) for row in missing[first:] + missing[:first]]
        count = max(min(workers, len(tasks) // _ENOUGH_FOR_PROCESSES), 1)
        with Workers(count, progress and process.leads) as pool:
            made = pool.run(_made, tasks, "preparing labels")
            found.update(zip(missing[first:] + missing[:first], made, strict=True))
        return [found[row] for row in range(len(self))]


def _made(task: tuple[LandmarkFiles, LabeledSequence]) -> Summary:
    files, sequence = task
    return files.summary(sequence) or files.make(replace(sequence))[1]  # the tables that it reads are dropped
