"""The label store: one folder per sequence, a manifest of all, nothing half-written, never one file per image.

    LABELS/
        manifest.parquet        one row per sequence: what it is, whether it is done, and if not, why
        settings.yaml           what the labels were made with; other settings are refused
        NAME/                   appears, complete, when the sequence is done
            tracks.parquet, points.parquet, trajectory.txt, map.ply, run.json
            frames.parquet      frame, index in the recording, time, segment, trusted
            images-00000.parquet ...   with --pack: the frames themselves
            label.json          this sequence's row of the manifest
            landmarks-*.safetensors   made by training from the tables, see `improvo.training.data.landmark_files`

A sequence in work lives in `.NAME.partial`, and whoever works on it holds `.NAME.lock`, so that several commands can
fill one store. What a killed run leaves there is cleared away by the next one. The manifest is made from the folders,
so it can be lost without harm.
"""

from __future__ import annotations

import dataclasses
import shutil
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from improvo.continuation import SettingsRecord
from improvo.errors import InputError, OutputError
from improvo.files import (
    check_folder_format,
    check_output_folder,
    is_being_written,
    make_output_folder,
    write_json,
    written_atomically,
)
from improvo.folder_lock import LOCK, BusyError, holder_of, locked, seems_held
from improvo.locations import lock_files, publish, removed
from improvo.sequences.given_files import CONTENTS
from improvo.untrusted.paths import is_text
from improvo.untrusted.text import read_json_file

MANIFEST_FILE, SETTINGS_FILE, RECORD_FILE = "manifest.parquet", "settings.yaml", "label.json"
DONE, FAILED = "done", "failed"
_COMMAND = "label"
_OTHER_SETTINGS = "use another folder, or --relabel"
_BEGIN_SECONDS = 10.0
_MANIFEST_SHARE = 20.0  # the manifest takes at most about so many times less than all else


@dataclass(frozen=True)
class SequenceRecord:
    """One row of the manifest."""

    name: str  # folder in the store
    path: str  # of the recording, absolute
    state: str  # DONE or FAILED
    reason: str = ""  # why it failed
    notes: str = ""  # what of it has no labels, and why
    format: str = ""
    frames: int = 0  # processed
    tracked: int = 0  # with a pose
    trusted: int = 0  # of those, by the quality gate
    segments: int = 0
    tracks: int = 0
    stable: int = 0
    unstable: int = 0
    ignore: int = 0
    withheld: int = 0  # labels that the quality gate took away
    packed: bool = False
    seconds: float = 0.0
    content: str = ""  # of the recording, see `improvo.sequences.content`; earlier versions did not write it


class LabelStore:
    """A folder of labels that is written to.

    Args:
        folder: made if need be.
        settings: everything that the labels depend on, as plain dictionaries.
        relabel: where the folder was made with other settings, clear it instead of refusing.
        kind: class of the settings, see `SettingsRecord`.

    Raises:
        OutputError: the folder is not ours or cannot be written.
        ConfigError: it was made with other settings.
    """

    def __init__(
        self,
        folder: Path,
        settings: dict[str, Any],
        relabel: bool = False,
        kind: type | None = None,
    ) -> None:
        check_output_folder(folder, _COMMAND)
        self.folder = folder
        self._refreshed, self._refresh_seconds = 0.0, 0.0
        made_with = SettingsRecord(folder / SETTINGS_FILE, kind, contents=CONTENTS)
        # failures alone, by a wrong mask, say: nothing is lost by other settings
        relabel = relabel or (bool(made_with.difference(settings)) and self._holds_only_failures())
        if not relabel:
            made_with.check(settings, _OTHER_SETTINGS)
        if not made_with.path.is_file():
            make_output_folder(folder, _COMMAND)
        with _alone(folder):
            if not relabel:
                made_with.check(settings, _OTHER_SETTINGS)  # what another command has recorded meanwhile
            elif made_with.difference(settings):
                self._discard()
            make_output_folder(folder, _COMMAND)
            self._clear_partials()
            made_with.write(settings)

    def _holds_only_failures(self) -> bool:
        """Whether something was tried here, nothing is done, and nobody is at work."""
        records = self.records() if self.folder.is_dir() else []
        held = any(seems_held(lock) for lock in self.folder.glob(".*.lock") if lock.name != LOCK)
        return bool(records) and not held and all(record.state != DONE for record in records)

    def _clear_partials(self) -> None:
        """Remove what nobody works on any more."""
        for leftover in self.folder.glob(".*.partial*"):
            if leftover.is_dir() and not leftover.is_symlink():
                if not seems_held(lock_of(self.folder, leftover.name[1:].removesuffix(".partial"))):
                    shutil.rmtree(leftover, ignore_errors=True)
            elif not is_being_written(leftover):
                leftover.unlink(missing_ok=True)

    def _discard(self) -> None:
        """Clear the folder of all sequences; one is gone, or there as a whole.

        Raises:
            BusyError: another command labels here.
        """
        for lock in {*self.folder.glob(".*.lock"), *lock_files(self.folder)}:
            if lock.name != LOCK and seems_held(lock):
                raise BusyError(self.folder, holder_of(lock) or "another process")
        for record in self.records():
            if record.state == DONE:
                (self.folder / record.name).rename(self.partial(record.name))
                removed(self.folder / record.name)
            else:
                _failure_of(self.folder, record.name).unlink(missing_ok=True)
                removed(_failure_of(self.folder, record.name))

    def records(self) -> list[SequenceRecord]:
        """All sequences that are done or have failed, by name."""
        return read_records(self.folder)

    def partial(self, name: str) -> Path:
        """The folder to label the sequence in, empty; it does not exist yet."""
        folder = self.folder / f".{name}.partial"
        shutil.rmtree(folder, ignore_errors=True)
        return folder

    def fail(self, record: SequenceRecord) -> None:
        """The sequence cannot be labelled: keep the reason, drop the rest. The next run tries again."""
        if not seems_held(lock_of(self.folder, record.name)):  # else somebody else tries already
            shutil.rmtree(self.folder / f".{record.name}.partial", ignore_errors=True)
        write_json(_failure_of(self.folder, record.name), asdict(record))
        self.refresh_manifest()

    def write_manifest(self) -> None:
        """`manifest.parquet` from what is there."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        types = {"str": pa.string(), "int": pa.int64(), "float": pa.float64(), "bool": pa.bool_()}
        schema = pa.schema([(field.name, types[str(field.type)]) for field in dataclasses.fields(SequenceRecord)])
        table = pa.Table.from_pylist([asdict(record) for record in self.records()], schema)
        with written_atomically(self.folder / MANIFEST_FILE) as temporary:
            pq.write_table(table, temporary)

    def refresh_manifest(self) -> None:
        """On the way: the folders are what counts, so a full disk is no failure of a sequence.

        Of many sequences it takes long, and is done less often.
        """
        before = time.monotonic()
        if before - self._refreshed < _MANIFEST_SHARE * self._refresh_seconds:
            return
        with suppress(OutputError):
            self.write_manifest()
        self._refreshed = time.monotonic()
        self._refresh_seconds = self._refreshed - before


def lock_of(folder: Path, name: str) -> Path:
    """What is held by whoever labels a sequence of a store, see `improvo.folder_lock`."""
    return folder / f".{name}.lock"


def finished_record(folder: Path, name: str) -> SequenceRecord | None:
    """Of a sequence of a store that is done."""
    file = folder / name / RECORD_FILE
    return _read_record(file) if file.is_file() else None


def finish_sequence(folder: Path, record: SequenceRecord) -> None:
    """The sequence in its partial folder is complete: it is now one of the store in `folder`.

    Raises:
        OutputError: it cannot be put in place.
    """
    partial, final = folder / f".{record.name}.partial", folder / record.name
    write_json(partial / RECORD_FILE, asdict(record))
    try:
        partial.rename(final)
    except OSError as error:
        raise OutputError(f"{final}: cannot be put in place ({error.strerror}); remove what is there") from None
    failure = _failure_of(folder, record.name)
    if failure.is_file():
        failure.unlink()
        removed(failure)
    publish(final)


def _failure_of(folder: Path, name: str) -> Path:
    return folder / f".{name}.failed.json"


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Nobody else begins or clears the store within the block, which is short: another command is waited for."""
    ends = time.monotonic() + _BEGIN_SECONDS
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(locked(folder))
                break
            except BusyError:
                if time.monotonic() > ends:
                    raise
                time.sleep(0.1)
        yield


def read_records(folder: Path) -> list[SequenceRecord]:
    """The records of a store, by name.

    Raises:
        InputError: no such folder, or a record that cannot be read.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; `improvo label` makes it")
    check_folder_format(folder)
    files = [*folder.glob(f"*/{RECORD_FILE}"), *folder.glob(".*.failed.json")]
    records: dict[str, SequenceRecord] = {}
    for file in files:
        if file.parent.name.startswith("."):  # in work; no sequence has a name like that
            continue
        record = _read_record(file)
        records.setdefault(record.name, record)  # labels come before an older failure of the same sequence
    return sorted(records.values(), key=lambda record: record.name)


def _read_record(file: Path) -> SequenceRecord:
    """The record in a file, which must be of the sequence that the file stands for.

    Raises:
        InputError: it is damaged.
    """
    mend = "remove it and run `improvo label` again"
    values = read_json_file(file, mend)
    kinds: dict[str, Any] = {"str": str, "int": int, "float": (int, float), "bool": bool}
    known = {field.name: kinds[str(field.type)] for field in dataclasses.fields(SequenceRecord)}
    wrong = next((name for name, value in values.items() if not isinstance(value, known.get(name, ()))), None)
    if wrong is None:
        with suppress(TypeError):  # one is missing
            record = SequenceRecord(**values)
            done = file.name == RECORD_FILE
            # the name becomes a path: it is taken from where the file lies, never from what the file says
            named = file.parent.name if done else file.name.removeprefix(".").removesuffix(".failed.json")
            if record.name == named and record.state == (DONE if done else FAILED):
                return record
    raise InputError(f"{file}: is damaged or of another sequence; {mend}")


def sequence_names(paths: list[Path], stored: Iterable[SequenceRecord] = ()) -> dict[str, Path]:
    """A folder name for each recording: that of its record, else one of its own that no other recording has.

    Names differ by more than the case of letters, which some file systems do not tell apart.

    Args:
        paths: of the recordings; the same list gives the same names.
        stored: records of the store that they go to, whatever list they were named in.

    Raises:
        InputError: a recording is named twice, or may be one of the store that has moved.
    """
    by_path = {record.path: record.name for record in stored}
    taken = {name.casefold(): path for path, name in by_path.items()}
    names: dict[str, Path] = {}
    used: set[str] = set()
    for path in paths:
        resolved = path.resolve()
        if not is_text(resolved):
            raise InputError(f"{path}: its name is no text, which tables of labels cannot hold; rename it")
        if resolved in names.values():
            raise InputError(f"{path}: is given twice")
        known = by_path.get(str(resolved))
        stem = (resolved.stem if resolved.is_file() else resolved.name).lstrip(".") or "sequence"
        of_that_name = taken.get(stem.casefold())
        if known is None and of_that_name is not None and not Path(of_that_name).exists():
            raise InputError(
                f"{path}: the store has a recording named {stem} of {of_that_name}, where there is none any more; "
                "if it has moved, move it back or use another folder"
            )
        name, number = known or stem, 2
        while known is None and (name.casefold() in used or name.casefold() in taken):
            name, number = f"{resolved.parent.name}-{stem}" if number == 2 else f"{stem}-{number}", number + 1
        names[name] = resolved
        used.add(name.casefold())
    return names
