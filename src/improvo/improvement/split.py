"""What is trained on and what is held back for validation: whole sequences, or the last part of a single one."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from improvo import config
from improvo.errors import ConfigError, InputError
from improvo.files import MARKER, write_json
from improvo.improvement.settings import SplitSettings
from improvo.labeling.store import DONE, RECORD_FILE, SETTINGS_FILE, SequenceRecord, sequence_names
from improvo.sequences import SequenceSettings, open_sequence
from improvo.terminal import counted
from improvo.untrusted.text import read_json_file

_MIN_FRAMES = 3  # of each part


@dataclass(frozen=True)
class Part:
    """Recordings that are read in one way."""

    paths: tuple[Path, ...]
    sequence: SequenceSettings


@dataclass(frozen=True)
class Split:
    """The two parts. They have no frame in common."""

    training: Part
    held_back: Part
    words: str  # what was held back, for a person
    unusable: tuple[str, ...] = ()  # recordings of neither part, each with its reason


def split_as_named(paths: Sequence[Path], evaluate: Sequence[Path], sequence: SequenceSettings) -> Split:
    """The split that a user names: `evaluate` is held back, also where it is among `paths`.

    Args:
        paths: recordings to train on.
        evaluate: recordings to hold back.
        sequence: how they are read.

    Raises:
        InputError: nothing is left to train on.
    """
    held = [path.resolve() for path in evaluate]
    rest = [path.resolve() for path in paths if path.resolve() not in held]
    if not rest:
        raise InputError(f"{paths[0]}: all sequences are held back with --evaluate; leave some to train on")
    return Split(Part(tuple(rest), sequence), Part(tuple(held), sequence), _words(held))


def split_last_part(path: Path, sequence: SequenceSettings, settings: SplitSettings) -> Split:
    """The split of a single recording: its last frames are held back, of those that are there.

    Args:
        path: of the recording.
        sequence: how it is read.
        settings: how many of its frames to hold back.

    Raises:
        InputError: it cannot be opened, does not end, or has too few frames.
    """
    opened = open_sequence(path, sequence)
    if opened.length is None:
        raise InputError(f"{path}: is a live stream; record it first")
    present = opened.present
    cut = len(present) - max(settings.frames_of_one(len(present)), _MIN_FRAMES)
    if cut < _MIN_FRAMES:
        raise InputError(
            f"{path}: has {counted(len(present), 'frame')}, too few to train on some and validate on the others; "
            "give a longer recording, some seconds at least, or several"
        )
    first_held, last = int(present[cut]), int(present[-1])
    training = replace(sequence, end=first_held, max_frames=None)
    held_back = replace(sequence, start=first_held, end=last + 1, max_frames=None)
    words = f"the last {len(present) - cut} of {len(present)} frames of {path.name}"
    if len(present) < len(opened):
        words += f" (of {len(opened)} that it lists)"
    return Split(Part((path.resolve(),), training), Part((path.resolve(),), held_back), words)


def split_whole_sequences(
    records: Sequence[SequenceRecord], sequence: SequenceSettings, settings: SplitSettings
) -> Split:
    """The split of several recordings that were all labelled: whole ones are held back, evenly spread over the list.

    Args:
        records: of all of them, in the user's order; those that could not be labelled are in neither part.
        sequence: how they are read.
        settings: how many of those labelled to hold back.

    Raises:
        InputError: only one could be labelled, and it is too short to be divided.
    """
    unusable = tuple(f"{record.name}: {record.reason}" for record in records if record.state != DONE)
    paths = [Path(record.path) for record in records if record.state == DONE]
    if len(paths) == 1:
        return replace(split_last_part(paths[0], sequence, settings), unusable=unusable)
    count = whole_held_back(len(paths), settings)
    chosen = {-(-len(paths) * (part + 1) // count) - 1 for part in range(count)}  # rounded up: never the first
    held = [path for row, path in enumerate(paths) if row in chosen]
    rest = [path for row, path in enumerate(paths) if row not in chosen]
    return Split(Part(tuple(rest), sequence), Part(tuple(held), sequence), _words(held), unusable)


def frames_there(path: Path, sequence: SequenceSettings) -> int:
    """How many frames a recording has, of those that it names; 0 of a live one.

    Raises:
        InputError: it cannot be opened.
    """
    opened = open_sequence(path, sequence)
    return 0 if opened.length is None else len(opened.present)


def whole_held_back(recordings: int, settings: SplitSettings) -> int:
    """How many of several recordings are held back; 0 of a single one, which is divided."""
    return min(max(1, round(recordings * settings.share_of_sequences)), recordings - 1)


def remembered_split(path: Path, choose: Callable[[], Split]) -> Split:
    """The split that `path` remembers from an earlier run, else the one that `choose` makes."""
    if path.is_file():
        return read_split(path)
    split = choose()
    values = config.to_dict(split)
    for part in ("training", "held_back"):
        values[part]["paths"] = [str(name) for name in values[part]["paths"]]
    write_json(path, values)
    return split


def read_split(path: Path) -> Split:
    """The split of an earlier run.

    Raises:
        InputError: it is damaged.
    """
    mend = "remove the folder and begin again"
    try:
        split = config.from_dict(Split, read_json_file(path, mend), where=str(path))
    except ConfigError as error:
        raise InputError(f"{error}: is damaged; {mend}") from None
    if not split.training.paths or not split.held_back.paths:
        raise InputError(f"{path}: is damaged; {mend}")
    return split


def share_labels(store: Path, records: Sequence[SequenceRecord], part: Part, target: Path) -> None:
    """Put the part's sequences of one label store into another of the same settings: they are not labelled twice.

    Files are hard links where the file system has them, copies elsewhere.

    Args:
        store: the label store that has them.
        records: of that store.
        part: the sequences that are wanted.
        target: the other label store, made if need be.
    """
    by_path = {record.path: record for record in records}
    target.mkdir(parents=True, exist_ok=True)
    for name in (MARKER, SETTINGS_FILE):
        shutil.copy2(store / name, target / name)
    for name, path in sequence_names(list(part.paths)).items():
        record = by_path[str(path)]
        partial, final = target / f".{name}.partial", target / name
        if final.exists():
            continue
        shutil.rmtree(partial, ignore_errors=True)
        shutil.copytree(store / record.name, partial, copy_function=_link)
        write_json(partial / RECORD_FILE, asdict(replace(record, name=name)))
        partial.rename(final)


def _link(source: str, target: str) -> str:
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
    return target


def _words(held: Sequence[Path]) -> str:
    names = [path.name for path in held]
    return ", ".join(names) if len(names) <= 5 else f"{', '.join(names[:5])} and {len(names) - 5} more sequences"
