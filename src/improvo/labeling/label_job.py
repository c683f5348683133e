"""One recording of many: the job to label it, which any process or machine can do, and the record of the result."""

from __future__ import annotations

import logging
import shutil
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from improvo.errors import ImprovoError, InputError, OutputError
from improvo.folder_lock import claimed
from improvo.jobs.processes import Tick
from improvo.labeling.frames import FRAMES_FILE, FramesTable, pack_images, write_frames
from improvo.labeling.labeler import run_and_label
from improvo.labeling.store import DONE, FAILED, RECORD_FILE, SequenceRecord, finish_sequence, finished_record, lock_of
from improvo.locations import folder_here, looked_up
from improvo.odometry.run_settings import RunSettings
from improvo.sequences.content import content_of

logger = logging.getLogger(__name__)
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


def failure_of(job: LabelJob, error: Exception) -> SequenceRecord:
    """What the manifest says of a sequence that could not be labelled."""
    if not isinstance(error, ImprovoError | OSError):
        logger.error("labelling %s failed unexpectedly", job.path, exc_info=error)
        error = InputError(f"{job.path}: unexpected {type(error).__name__}: {' '.join(str(error).split())}")
    return replace(SequenceRecord(job.name, str(job.path), FAILED), reason=str(error))


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
