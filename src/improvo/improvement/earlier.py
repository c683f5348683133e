"""A growing set of recordings: what runs of the loop before this one leave for it to be replayed and judged by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from improvo.continuation import SettingsRecord
from improvo.errors import InputError
from improvo.improvement.reference import TRAINING, ReferencePart, reference_parts
from improvo.improvement.rounds import starting_weights
from improvo.improvement.settings import DEFAULT_START
from improvo.improvement.split import Split, read_split

SETTINGS, SPLIT, REFERENCE, WEIGHTS = "settings.yaml", "split.json", "reference", "weights.safetensors"
_FIRST_ROUND = "round-1/judgement.json"  # weights are there before it: those of the start


@dataclass(frozen=True)
class Earlier:
    """Finished folders of the loop, the latest first: each began with the weights of the next."""

    folders: tuple[Path, ...] = ()

    @property
    def splits(self) -> tuple[Split, ...]:
        """What each of them trained on and held back."""
        return tuple(read_split(folder / SPLIT) for folder in self.folders)

    @property
    def weights(self) -> Path | None:
        """The latest; None without any folder."""
        return self.folders[0] / WEIGHTS if self.folders else None

    def first_weights(self, named: str) -> Path:
        """The weights that the loop starts from: the latest, unless the settings name another frontend.

        Args:
            named: frontend of the settings.

        Raises:
            ConfigError: a frontend that has no weights.
            InputError: no such file.
        """
        return self.weights if self.weights and named == DEFAULT_START else starting_weights(named)

    def without_known(self, sequences: Sequence[Path]) -> list[Path]:
        """The recordings that none of them has had.

        Raises:
            InputError: there is none.
        """
        parts = [part for split in self.splits for part in (split.training, split.held_back)]
        known = {path.resolve() for part in parts for path in part.paths}
        new = [path for path in sequences if path.resolve() not in known]
        if sequences and not new:
            raise InputError(f"{sequences[0]}: {self.folders[0]} and those before it had all recordings; add new ones")
        return new

    def refuse_taught(self, evaluate: Sequence[Path]) -> None:
        """What one of them was trained on is not unseen, and cannot be held back.

        Raises:
            InputError: a recording of `evaluate` is.
        """
        for folder, split in zip(self.folders, self.splits, strict=True):
            taught = {path.resolve() for path in split.training.paths}
            for path in evaluate:
                if path.resolve() in taught:
                    raise InputError(f"{path}: {folder} was trained on it, so it cannot be held back; give others")

    def parts(self, kind: str) -> list[ReferencePart]:
        """Their training parts, or what they held back, with the depth that they have of them.

        Args:
            kind: `reference.TRAINING` or `reference.HELD_BACK`.
        """
        found: list[ReferencePart] = []
        names = [folder.name for folder in self.folders]
        for row, (folder, split) in enumerate(zip(self.folders, self.splits, strict=True)):
            part = split.training if kind == TRAINING else split.held_back
            name = names[row] if names.count(names[row]) == 1 else f"{names[row]} {len(names) - row}"
            found += [
                replace(one, name=f"{name}/{one.name}", earlier=True)
                for one in reference_parts(folder / REFERENCE, part, kind)
                if one.depth_file.is_file()
            ]
        return found


def earlier_runs(folder: Path | None) -> Earlier:
    """A finished folder of the loop and those that it followed.

    Args:
        folder: None for a loop that follows none.

    Raises:
        InputError: it is no such folder, or not finished.
    """
    found: list[Path] = []
    while folder is not None:
        folder = folder.resolve()
        if not all((folder / name).is_file() for name in (SETTINGS, SPLIT, WEIGHTS, _FIRST_ROUND)):
            raise InputError(f"{folder}: is no finished folder of `improvo improve`; finish it, or give another one")
        if folder in found:
            raise InputError(f"{folder}: follows itself; its settings.yaml is damaged")
        found.append(folder)
        record = SettingsRecord(folder / SETTINGS).read()
        before = record.get("after") if isinstance(record, dict) else None
        folder = Path(str(before)) if before else None
    return Earlier(tuple(found))
