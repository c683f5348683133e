"""Labels of many sequences: resumable, and the failure of one spoils no other."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from improvo.config import to_dict
from improvo.errors import InputError, OutputError
from improvo.files import content_hash
from improvo.folder_lock import BusyError, seems_held
from improvo.jobs.crew import Crew
from improvo.labeling.label_job import LabelJob, failure_of, label_sequence
from improvo.labeling.store import DONE, LabelStore, SequenceRecord, sequence_names
from improvo.locations import LOCATION_ERRORS, lock_files, refresh, url_of
from improvo.odometry.run_settings import RunSettings
from improvo.sequences.content import content_of
from improvo.sequences.given_files import contents_of_given, with_absolute_files

logger = logging.getLogger(__name__)
_POLL_SECONDS = 1.0
_LOOK_AGAIN_SECONDS = 60.0


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
    record = result if isinstance(result, SequenceRecord) else failure_of(job, result)
    try:
        store.fail(record)
    except OutputError as error:
        logger.warning("%s", error)
    return record


def fingerprint(settings: RunSettings, pack: bool) -> dict[str, Any]:
    """Everything that the labels depend on; weights, camera and mask by what is in them."""
    values = {**to_dict(settings), "pack": pack, **contents_of_given(settings.sequence)}
    weights = Path(settings.frontend.name)
    if weights.suffix == ".safetensors" and weights.is_file():
        values["frontend"]["name"] = f"sha256:{content_hash(weights)}"
    return values
