"""The output folder of the loop: what is where, and that it is continued only as it was begun."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from improvo import config
from improvo.continuation import SettingsRecord, value_of
from improvo.errors import ConfigError
from improvo.files import check_output_folder, content_hash, make_output_folder
from improvo.improvement.settings import USUAL_SHARE, ImproveSettings
from improvo.locations import removed
from improvo.sequences.given_files import CONTENTS, contents_of_given

COMMAND = "improve"
_CONTROL = "control-"
# settings of the optimiser that may differ when a run is continued: none of these alters a result
_FREE = ("device", "threads", "workers", "checkpoint_minutes", "log_every")


@dataclass(frozen=True)
class Candidate:
    """A frontend of the loop with all that is known of it: the one at the start, or one that a round has trained.

    NAME/
        weights.safetensors, .json   what it is
        held-back/                   label store of what was held back, made with it
        judgement.json               its `Validation`; written last
        labels/                      label store of the training part, made with it, once it is the teacher
        training/                    of a round: metrics and checkpoints
        pictures/
    """

    name: str  # "start", "round 1"
    folder: Path

    @property
    def is_control(self) -> bool:
        """Whether it was trained by homographies alone."""
        return self.folder.name.startswith(_CONTROL)

    @property
    def weights(self) -> Path:
        """Its weights file, ready for the same runtime as that of every other candidate."""
        return self.folder / "weights.safetensors"

    @property
    def labels(self) -> Path:
        """Label store of the training part."""
        return self.folder / "labels"

    @property
    def held_back(self) -> Path:
        """Label store of the part to validate on."""
        return self.folder / "held-back"

    @property
    def training(self) -> Path:
        """Where it was trained."""
        return self.folder / "training"

    @property
    def validation(self) -> Path:
        """How good it is, see `improvo.improvement.validation`."""
        return self.folder / "judgement.json"


class ImproveFolder:
    """OUT/
        settings.yaml          what the result depends on; other settings are refused
        split.json             which frames are trained on, and which held back
        reference/             the fixed run that teaches and judges: labels, depth-training.zip, depth-held-back.zip
        start/, round-1/ ...   a `Candidate` each; control-1/, control-2/ ... are too
        weights.safetensors    the best of them, with weights.json
        report.html

    Args:
        folder: made if need be.
        sequences: as given by the user.
        evaluate: as given by the user.
        settings: of the loop.
        start: weights file that it starts from.
        after: finished folder of the loop that this one follows; may be none.

    Raises:
        OutputError: the folder is not ours, or cannot be written.
        ConfigError: it was begun with other settings, recordings or weights.
    """

    def __init__(
        self,
        folder: Path,
        sequences: Sequence[Path],
        evaluate: Sequence[Path],
        settings: ImproveSettings,
        start: Path,
        after: Path | None = None,
    ) -> None:
        check_output_folder(folder, COMMAND)
        self.folder = folder
        values = config.to_dict(settings)
        values["frontend"]["name"] = f"sha256:{content_hash(start)}"
        values |= contents_of_given(settings.sequence)
        values["sequences"] = [str(path.resolve()) for path in sequences]
        values["evaluate"] = [str(path.resolve()) for path in evaluate]
        if after is not None:
            values["after"] = str(after.resolve())
        self._begin(values)

    @property
    def split(self) -> Path:
        """What is trained on, and what held back."""
        return self.folder / "split.json"

    @property
    def reference(self) -> Path:
        """Label store of the reference run: all recordings whole, with depth, by the frontend at the start."""
        return self.folder / "reference"

    @property
    def start(self) -> Candidate:
        """The frontend before any improvement."""
        return Candidate("start", self.folder / "start")

    def round(self, number: int) -> Candidate:
        """The frontend that a round has trained."""
        return Candidate(f"round {number}", self.folder / f"round-{number}")

    def control(self, rounds: int) -> Candidate:
        """The start, trained for so many rounds by homographies alone; never the best."""
        name = "control" if rounds == 1 else f"control, {rounds} rounds"
        return Candidate(name, self.folder / f"{_CONTROL}{rounds}")

    def finished_rounds(self) -> int:
        """How many rounds are complete."""
        number = 0
        while self.round(number + 1).validation.is_file():
            number += 1
        return number

    @property
    def weights(self) -> Path:
        """The best weights."""
        return self.folder / "weights.safetensors"

    @property
    def report(self) -> Path:
        """What to look at."""
        return self.folder / "report.html"

    @staticmethod
    def _refuse_former(record: SettingsRecord) -> None:
        """Folders without a reference were validated by other measures, which cannot be compared.

        Raises:
            ConfigError: it is such a folder.
        """
        if "reference" not in (record.read() or {}):
            raise ConfigError(
                f"{record.path.parent}: was begun by an earlier version, which measured otherwise; choose another "
                "output folder (--frontend takes its weights.safetensors)"
            )

    def _begin(self, values: dict[str, Any]) -> None:
        free = [f"{section}.optimiser.{name}" for section in ("training", "held") for name in _FREE]
        free += ["training.memory_mib", "control"]  # a control may be added later
        record = SettingsRecord(self.folder / "settings.yaml", ImproveSettings, free, CONTENTS)
        if self.split.is_file():
            self._refuse_former(record)
            recorded = value_of("split.share", record.read())
            if recorded == USUAL_SHARE and values["split"]["share"] is None:  # it was the default; the split is made
                values["split"]["share"] = recorded
            record.check(values, "give the same again, or another output folder")
        elif record.difference(values):  # nothing has come of it yet
            for folder in (self.reference, self.start.folder):
                shutil.rmtree(folder, ignore_errors=True)
                removed(folder)
        make_output_folder(self.folder, COMMAND)
        record.write(values)
        for leftover in list(self.folder.rglob(".*.partial*")):  # of a killed run; some lie in others
            if leftover.is_dir() and not leftover.is_symlink():
                shutil.rmtree(leftover, ignore_errors=True)
            else:
                leftover.unlink(missing_ok=True)
