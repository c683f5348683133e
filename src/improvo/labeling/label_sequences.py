"""Labels of many sequences: resumable, and the failure of one spoils no other."""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from improvo.config import to_dict
from improvo.errors import ImprovoError, InputError, OutputError
from improvo.files import content_hash
from improvo.folder_lock import BusyError, claimed, seems_held
from improvo.jobs.crew import Crew
from improvo.jobs.processes import Tick
from improvo.labeling.frames import FRAMES_FILE, FramesTable, pack_images, write_frames
from improvo.labeling.labeler import run_and_label
from improvo.labeling.store import (
    DONE,
    FAILED,
    RECORD_FILE,
    LabelStore,
    SequenceRecord,
    finish_sequence,
    finished_record,
    lock_of,
    sequence_names,
)
from improvo.locations import LOCATION_ERRORS, folder_here, lock_files, looked_up, refresh, url_of
from improvo.odometry.run_settings import RunSettings
from improvo.sequences.content import content_of
from improvo.sequences.given_files import contents_of_given, with_absolute_files

logger = logging.getLogger(__name__)
_POLL_SECONDS = 1.0
_LOOK_AGAIN_SECONDS = 60.0
_MEND = "record with a camera that moves sideways or forwards, past things with texture, for some seconds"
_REASONS = {  # why the quality gate does not trust frames
    "high_error": "that fit badly",
    "little_parallax": "of little parallax",
    "contradicted": "in doubt",
    "doubtful": "of a doubtful path",
}


@dataclass(frozen=True)
class LabelJob:
    """One sequence to label."""

    name: str
    path: Path
    store: Path
    settings: RunSettings
    pack: bool
    url: str = ""  # of the store, where it is at a location

    @property
    def folder(self) -> Path:
        """To write in."""
        return self.store / f".{self.name}.partial"

    @property
    def lock(self) -> Path:
        """Held while it is done."""
        return lock_of(self.store, self.name)


def label_sequences(
    paths: Sequence[Path],
    folder: Path,
    settings: RunSettings,
    workers: int | None = None,
    pack: bool = False,
    relabel: bool = False,
    ray: str | None = None,
    on_record: Callable[[SequenceRecord], None] = lambda record: None,
    on_frames: Callable[[int], None] = lambda count: None,
    on_wait: Callable[[str, str], None] = lambda name, holder: None,
) -> list[SequenceRecord]:
    """Label every recording that the store does not have yet.

    Several commands, on machines that share the folder, do it together: each takes what nobody works on, and then waits
    for the rest.

    Args:
        paths: of the recordings.
        folder: of the label store, see `improvo.labeling.store`.
        settings: of the odometry and the labels.
        workers: sequences at a time, a process with one core for each. If None, one after another in this process, or
            with `ray` as many as the cluster has cores.
        pack: whether to keep the frames beside the labels.
        relabel: where the store was made with other settings, clear it instead of refusing.
        ray: address of a Ray cluster that does the work, see `improvo.jobs.on_ray`.
        on_record: is told each sequence as it is done, has failed, or was done before.
        on_frames: is told the number of further frames processed.
        on_wait: is told the name of a sequence that another process labels, and which process.

    Returns:
        The records of the given recordings, in their order.

    Raises:
        InputError: none of them could be labelled, or there is no Ray cluster.
        MissingExtraError: Ray is not installed.
        OutputError, ConfigError: the store cannot be used, see `LabelStore`, or its location does not answer any more.
    """
    sequence_names(list(paths))  # refuses what is given twice before there is a store
    settings = replace(settings, sequence=with_absolute_files(settings.sequence))
    store = LabelStore(folder, fingerprint(settings, pack), relabel, type(settings))
    # a failure whose recording is gone leaves its name to whoever comes
    stored = [record for record in store.records() if record.state == DONE or Path(record.path).exists()]
    names = sequence_names(list(paths), stored)
    before = {record.name: record for record in stored if record.state == DONE}
    records = {name: before[name] for name in names if name in before}
    for name, record in records.items():
        _refuse_changed(names[name], record, folder / name, settings)
    for record in records.values():
        on_record(record)
    url = url_of(store.folder)
    jobs = [
        LabelJob(name, path, store.folder, settings, pack, url) for name, path in names.items() if name not in before
    ]

    def run(jobs: Sequence[LabelJob]) -> list[LabelJob]:
        """Do them; returns those that somebody else works on."""
        elsewhere: list[LabelJob] = []

        def on_result(job: LabelJob, result: SequenceRecord | Exception) -> None:
            if isinstance(result, BusyError):
                elsewhere.append(job)
                on_wait(job.name, result.holder)
                return
            if isinstance(result, LOCATION_ERRORS):  # of no use to label on
                raise result
            records[job.name] = _stored(store, job, result)
            on_record(records[job.name])

        crew.do(label_sequence, jobs, on_result, on_frames, gpus)
        return elsewhere

    taken = set(lock_files(store.folder))  # by other machines; the others first
    jobs.sort(key=lambda job: job.lock in taken)
    crew = Crew(workers, ray)
    gpus = int(ray is not None and settings.frontend.network.device == "cuda")
    while jobs:
        jobs = run(jobs)
        _wait_for_one(jobs)
    refresh(store.folder)
    try:
        store.write_manifest()
    except OutputError as error:  # the labels do not need it, and the next run writes it
        logger.warning("%s", error)
    if not any(record.state == DONE for record in records.values()):
        first = records[next(iter(names))]
        raise InputError(f"nothing could be labelled; {first.name}: {first.reason}")
    return [records[name] for name in names]


def _wait_for_one(jobs: Sequence[LabelJob]) -> None:
    """Until one of the sequences that others work on is done or let go; not for ever, since their machine may die."""
    ends = time.monotonic() + _LOOK_AGAIN_SECONDS
    while jobs and time.monotonic() < ends:
        if any(not seems_held(job.lock) for job in jobs):
            return
        time.sleep(_POLL_SECONDS)


def label_sequence(job: LabelJob, tick: Tick) -> SequenceRecord:
    """Label one recording into its folder of the store, unless that is done.

    Returns:
        What was found. Where frames were tracked and no track has a label, it is a failure that says how many were.

    Raises:
        InputError: no frame got a pose.
        BusyError: another process does it.
        KeyboardInterrupt: it was interrupted; the partial folder is worth nothing.
    """
    job = replace(job, store=folder_here(job.store, job.url))
    with claimed(job.lock, job.path):
        looked_up(job.store / job.name / RECORD_FILE)  # another machine may have done it
        done = finished_record(job.store, job.name)
        if done is not None:
            return done
        shutil.rmtree(job.folder, ignore_errors=True)
        try:
            record = _labeled(job, tick)
            if record.state == DONE:
                finish_sequence(job.store, record)
            else:
                shutil.rmtree(job.folder, ignore_errors=True)
        except Exception:
            shutil.rmtree(job.folder, ignore_errors=True)
            raise
        return record


def _labeled(job: LabelJob, tick: Tick) -> SequenceRecord:
    """Label one recording into its partial folder."""
    from improvo.sequences import open_sequence

    started = time.perf_counter()
    sequence = open_sequence(job.path, job.settings.sequence)
    content = content_of(sequence.recording)  # what it was before
    labeled = run_and_label(sequence, job.folder, job.settings, "label", progress=lambda view: tick())
    report, quality, trajectory = labeled.report, labeled.quality, labeled.trajectory
    if report["interrupted"]:
        raise KeyboardInterrupt
    if labeled.tracked == 0:
        raise InputError(f"{job.path}: no frame got a pose: {_last_reason(report)}; {_MEND}")
    counts = report["tracks"]
    record = SequenceRecord(
        name=job.name,
        path=str(job.path),
        state=DONE,
        notes=_notes(report, quality.counts()),
        format=sequence.format,
        frames=len(trajectory),
        tracked=labeled.tracked,
        trusted=int(quality.trusted.sum()),
        segments=len(report["segments"]),
        tracks=counts["tracks"],
        stable=counts["stable"],
        unstable=counts["unstable"],
        ignore=counts["ignore"],
        withheld=counts["withheld"],
        packed=job.pack,
        seconds=round(time.perf_counter() - started, 3),
        content=content,
    )
    if counts["stable"] + counts["unstable"] == 0:
        why = f"{job.path}: no track has a label ({_why_none(quality.counts(), counts)}); {_MEND}"
        return replace(record, state=FAILED, reason=why, packed=False)
    frames = FramesTable(
        frame=np.arange(len(trajectory)),
        source_index=np.array(report["frames"]["source_index"], np.int64),
        time=trajectory.times,
        segment=trajectory.segment,
        trusted=quality.trusted,
    )
    write_frames(job.folder / FRAMES_FILE, frames)
    if job.pack:
        try:
            pack_images(job.folder, ((frame.image, frame.mask) for frame in sequence))
        except OSError as error:
            raise OutputError(f"{job.folder}: the frames cannot be packed ({error}); choose another folder") from None
    return replace(record, seconds=round(time.perf_counter() - started, 3))


def _refuse_changed(path: Path, record: SequenceRecord, folder: Path, settings: RunSettings) -> None:
    """Refuse labels of what was there under this path before.

    Raises:
        InputError: the recording is another one than was labelled.
    """
    from improvo.sequences import open_recording

    if record.content and content_of(open_recording(path, settings.sequence)) != record.content:
        raise InputError(
            f"{path}: is not what {folder} was made from, it has changed since; remove that folder, and it is made "
            "again, or choose another output folder"
        )


def _stored(store: LabelStore, job: LabelJob, result: SequenceRecord | Exception) -> SequenceRecord:
    """The record of a result, which is kept if it is a failure."""
    if isinstance(result, SequenceRecord) and result.state == DONE:
        store.refresh_manifest()
        return result
    record = result if isinstance(result, SequenceRecord) else _failure(job, result)
    try:
        store.fail(record)
    except OutputError as error:
        logger.warning("%s", error)
    return record


def _failure(job: LabelJob, error: Exception) -> SequenceRecord:
    """What the manifest says of a sequence that could not be labelled."""
    if not isinstance(error, ImprovoError | OSError):
        logger.error("labelling %s failed unexpectedly", job.path, exc_info=error)
        error = InputError(f"{job.path}: unexpected {type(error).__name__}: {' '.join(str(error).split())}")
    return replace(SequenceRecord(job.name, str(job.path), FAILED), reason=str(error))


def fingerprint(settings: RunSettings, pack: bool) -> dict[str, Any]:
    """Everything that the labels depend on; weights, camera and mask by what is in them."""
    values = {**to_dict(settings), "pack": pack, **contents_of_given(settings.sequence)}
    weights = Path(settings.frontend.name)
    if weights.suffix == ".safetensors" and weights.is_file():
        values["frontend"]["name"] = f"sha256:{content_hash(weights)}"
    return values


def _last_reason(report: dict[str, Any]) -> str:
    events = report["events"]
    return events[-1]["detail"] if events else "too little motion or texture"


def _notes(report: dict[str, Any], quality: dict[str, int]) -> str:
    """What of a labelled sequence has no labels, and why, in one line."""
    notes = []
    if skipped := report["input"]["skipped"]:
        notes.append(f"{len(skipped)} unreadable (first: frame {skipped[0]['index']}, {skipped[0]['reason']})")
    if lost := report["frames"]["lost_frames"]:
        why = {event["frame_index"]: event["detail"] for event in report["events"]}
        notes.append(f"{len(lost)} without a pose (first: frame {lost[0]}, {why.get(lost[0], _last_reason(report))})")
    if len(report["segments"]) > 1:
        starts = ", ".join(str(segment["first"]) for segment in report["segments"][1:])
        notes.append(f"tracking began anew at frame {starts}")
    notes += [f"{quality[name]} {words}" for name, words in _REASONS.items() if quality[name]]
    return "; ".join(notes)


def _why_none(quality: dict[str, int], counts: dict[str, int]) -> str:
    if counts["withheld"]:
        words = {**_REASONS, "no_pose": "without a pose"}
        frames = ", ".join(f"{quality[name]} {text}" for name, text in words.items() if quality[name])
        return f"{counts['withheld']} withheld: its frames are not to be trusted, {frames}"
    return "none is long enough, or all are in between stable and unstable"
