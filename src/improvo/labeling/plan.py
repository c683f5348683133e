"""What labelling will cost, measured on a sample: core-hours, memory, disk, and time by the number of workers.

A sample is the beginning of a few of the recordings, labelled in a process like that of a worker. Its processor time is
measured and not its duration, so that other work on the machine hardly matters. The cost of a recording is taken to be
a number for itself and one for each frame. The latter is that of the later frames of a sample; what opening and the
first frames, which need a start of the map, cost beyond it is the former. A sample that is a whole recording needs no
such distinction: all its frames count.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from improvo.errors import InputError
from improvo.jobs.processes import Tick, run_in_processes
from improvo.labeling.label_job import LabelJob, label_sequence
from improvo.labeling.label_sequences import fingerprint
from improvo.labeling.store import DONE, LabelStore
from improvo.odometry.run_settings import RunSettings

SAMPLE_FRAMES = 150  # of a recording
_SAMPLES = 3  # recordings, at least
_ALL_SAMPLE_FRAMES = 450  # more recordings, where they are so short that all samples together have less
_START_FRAMES = 30  # not counted in the seconds of a frame
_LOOKED_AT = 100  # recordings that are opened for their length, at most
_MIB = 1 << 20


@dataclass(frozen=True)
class LabelPlan:
    """Of labelling some recordings with one core for each worker."""

    recordings: int
    frames: int  # of all; extrapolated where there are many recordings
    longest_frames: int  # of one recording, which one worker does
    sample_frames: int
    frame_seconds: float  # of one core, for a frame
    recording_seconds: float  # of one core, for a recording beside its frames: opening it, the start of its map
    memory_mib: int  # of a worker; 0 where the system does not say
    frame_bytes: float  # on disk

    @property
    def core_seconds(self) -> float:
        """Of all."""
        return self.frames * self.frame_seconds + self.recordings * self.recording_seconds

    @property
    def storage_mib(self) -> float:
        """Of the label store."""
        return self.frames * self.frame_bytes / _MIB

    def seconds(self, workers: int) -> float:
        """With so many workers, each with a free core; no less than the longest recording takes."""
        longest = self.longest_frames * self.frame_seconds + self.recording_seconds
        return max(self.core_seconds / min(workers, self.recordings), longest)


@dataclass(frozen=True)
class _Sample:
    """What one sample took."""

    frames: int
    recording: float  # seconds of the processor beside those of the frames
    frame: float  # for a later frame, with its share of what is done at the end
    memory_mib: int
    folder_bytes: int


def plan_labels(
    paths: Sequence[Path],
    settings: RunSettings,
    pack: bool = False,
    on_frames: Callable[[int], None] = lambda count: None,
    folder: Path | None = None,
) -> LabelPlan:
    """Label a sample, and reckon.

    Args:
        paths: of the recordings.
        settings: of the odometry and the labels.
        pack: whether the frames are kept beside the labels.
        on_frames: is told the number of further frames of the sample processed.
        folder: label store to keep the samples in, without any labels yet; nothing is kept if None.

    Raises:
        InputError: none of the samples could be labelled, or the store has labels already, which cost nothing again.
    """
    lengths = _lengths(paths, settings)
    if not lengths:
        raise InputError(f"no recording can be opened; the first: {_why_not(paths[0], settings)}")
    tried = list(lengths)
    most = _sample_frames(settings)
    count = max(_SAMPLES, _ALL_SAMPLE_FRAMES // max(round(np.mean([min(n, most) for n in lengths.values()])), 1))
    chosen = [tried[row] for row in np.unique(np.linspace(0, len(tried) - 1, count).round().astype(int))]
    short = replace(settings, sequence=replace(settings.sequence, max_frames=most))
    samples: list[_Sample] = []
    failures: list[Exception] = []

    def on_result(job: LabelJob, result: _Sample | Exception) -> None:
        if isinstance(result, _Sample):
            samples.append(result)
        else:
            failures.append(result)

    with tempfile.TemporaryDirectory(prefix="improvo-plan-") as temporary:
        kept = LabelStore(folder or Path(temporary), fingerprint(short, pack), kind=type(short))
        if kept.records():
            raise InputError(f"{folder}: has labels already; give a new folder for the samples of a plan")
        store = kept.folder
        jobs = [LabelJob(f"sample-{row}", path, store, short, pack) for row, path in enumerate(chosen)]
        run_in_processes(_sampled, jobs, on_result, on_frames, 1)
    if not samples:
        raise InputError(f"no sample could be labelled; the first: {failures[0]}")
    mean_length = float(np.mean(list(lengths.values())))
    return LabelPlan(
        recordings=len(paths),
        frames=sum(lengths.values()) if len(lengths) == len(paths) else round(mean_length * len(paths)),
        longest_frames=max(lengths.values()),
        sample_frames=sum(sample.frames for sample in samples),
        frame_seconds=float(np.average([s.frame for s in samples], weights=[s.frames for s in samples])),
        recording_seconds=float(np.median([sample.recording for sample in samples])),
        memory_mib=max(sample.memory_mib for sample in samples),
        frame_bytes=sum(sample.folder_bytes for sample in samples) / sum(sample.frames for sample in samples),
    )


def _lengths(paths: Sequence[Path], settings: RunSettings) -> dict[Path, int]:
    """Frames of the recordings that can be opened, of a part of them where there are many."""
    from improvo.sequences import open_sequence

    lengths: dict[Path, int] = {}
    for row in np.unique(np.linspace(0, len(paths) - 1, _LOOKED_AT).round().astype(int)):
        with suppress(InputError):
            sequence = open_sequence(paths[row], settings.sequence)
            if sequence.length and len(sequence.present):
                lengths[paths[row]] = len(sequence.present)
    return lengths


def _why_not(path: Path, settings: RunSettings) -> str:
    """What is wrong with a recording whose length is not known."""
    from improvo.sequences import open_sequence

    try:
        open_sequence(path, settings.sequence)
    except InputError as error:
        return str(error)
    return f"{path}: is a stream, which has no end; record it first"


def _sample_frames(settings: RunSettings) -> int:
    most = settings.sequence.max_frames
    return SAMPLE_FRAMES if most is None else min(most, SAMPLE_FRAMES)


def _sampled(job: LabelJob, tick: Tick) -> _Sample:
    """Label the sample in this process, and look at the clock of the processor."""
    begun = time.process_time()
    ticks: list[float] = []

    def timed() -> None:
        ticks.append(time.process_time())
        tick()

    record = label_sequence(job, timed)
    if record.state != DONE:
        raise InputError(record.reason)
    ended = time.process_time()
    whole = len(ticks) < (job.settings.sequence.max_frames or 0)
    first = 1 if whole else min(_START_FRAMES, len(ticks) // 2)
    frame = (ended - ticks[first - 1]) / max(len(ticks) - first, 1)
    recording = max(ended - begun - frame * len(ticks), 0.0)
    files = [path for path in (job.store / job.name).rglob("*") if path.is_file()]
    size = sum(path.stat().st_size for path in files)
    return _Sample(record.frames, recording, frame, _peak_mib(), size)


def _peak_mib() -> int:
    """Largest resident memory of this process so far; 0 where the system does not say."""
    try:
        import resource
    except ImportError:  # not on Windows
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(peak // (_MIB if sys.platform == "darwin" else 1024))
