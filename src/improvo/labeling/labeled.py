"""Reading a label store: what training and reports are given."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from improvo import config
from improvo.continuation import SettingsRecord
from improvo.errors import InputError
from improvo.geometry.camera import Camera
from improvo.geometry.se3 import inverse
from improvo.labeling.frames import FRAMES_FILE, FramesTable, PackedImages, read_frames
from improvo.labeling.store import DONE, SETTINGS_FILE, SequenceRecord, read_records
from improvo.locations import fetched
from improvo.sequences.base import SequenceSettings
from improvo.stability.settings import LabelSettings
from improvo.stability.tables import POINTS_FILE, TRACKS_FILE, PointsTable, TracksTable, read_points, read_tracks
from improvo.types import Float64, Int64, Mask, UInt8
from improvo.untrusted.text import read_json_file, reason

if TYPE_CHECKING:
    from improvo.sequences import Sequence

RUN_FILE, TRAJECTORY_FILE = "run.json", "trajectory.txt"


@dataclass(frozen=True)
class LabeledSequence:
    """One finished sequence of a store; tables are read when they are first asked for."""

    folder: Path
    record: SequenceRecord
    settings: SequenceSettings  # how its recording was read
    rule: LabelSettings  # what the labels were made by

    @property
    def name(self) -> str:
        """Its folder in the store."""
        return self.record.name

    @cached_property
    def tracks(self) -> TracksTable:
        """One row per observation."""
        return read_tracks(self.folder / TRACKS_FILE)

    @cached_property
    def points(self) -> PointsTable:
        """One row per track, with its label."""
        return read_points(self.folder / POINTS_FILE)

    @cached_property
    def frames(self) -> FramesTable:
        """One row per processed frame."""
        return read_frames(self.folder / FRAMES_FILE)

    @cached_property
    def camera(self) -> Camera:
        """The pinhole camera of the processed frames."""
        try:
            return Camera(**read_json_file(fetched(self.folder / RUN_FILE), "label it again")["camera"])
        except (OSError, LookupError, TypeError, ValueError, InputError) as error:
            raise InputError(f"{self.folder / RUN_FILE}: cannot be read ({reason(error)}); label it again") from None

    @cached_property
    def cam_from_world(self) -> Float64:
        """(F, 4, 4) final poses by frame, NaN where there is none; a segment has its own world."""
        from improvo.sequences import read_trajectory

        posed = self.frames.segment >= 0
        trajectory = read_trajectory(fetched(self.folder / TRAJECTORY_FILE))
        if len(trajectory) != posed.sum():
            raise InputError(f"{self.folder}: {TRAJECTORY_FILE} and {FRAMES_FILE} disagree; label it again")
        poses = np.full((len(posed), 4, 4), np.nan)
        poses[posed] = inverse(trajectory.world_from_cam)
        return poses

    def image(self, frame: int) -> UInt8:
        """The grey image (H, W) of a frame of the processed sequence, packed or from the recording.

        Raises:
            InputError: neither is there.
        """
        return self._images.image(frame)

    def mask(self, frame: int) -> Mask | None:
        """Where keypoints may be in a frame of the processed sequence (H, W); None is everywhere."""
        return None if self.settings.mask is None else self._images.mask(frame)

    @cached_property
    def _images(self) -> PackedImages | _RecordedImages:
        if self.record.packed:
            return PackedImages(self.folder)
        from improvo.sequences import open_sequence

        sequence = open_sequence(self.record.path, self.settings)
        return _RecordedImages(sequence, np.searchsorted(sequence.indices, self.frames.source_index))


class _RecordedImages:
    """Frames of the processed sequence from the recording; `rows` (F,) are theirs in the sequence."""

    def __init__(self, sequence: Sequence, rows: Int64) -> None:
        self._sequence, self._rows = sequence, rows

    def image(self, frame: int) -> UInt8:
        return self._sequence[int(self._rows[frame])].image

    def mask(self, frame: int) -> Mask | None:
        return self._sequence.mask(int(self._rows[frame]))


def read_labels(folder: Path | str) -> list[LabeledSequence]:
    """All finished sequences of a store, by name.

    Raises:
        InputError: no store, or one without any finished sequence.
    """
    folder = Path(folder)
    records = read_records(folder)
    try:
        values = SettingsRecord(folder / SETTINGS_FILE).read()
        if not isinstance(values, dict):
            raise TypeError
        settings = config.from_dict(SequenceSettings, values["sequence"], where=str(folder / SETTINGS_FILE))
        rule = config.from_dict(LabelSettings, values["labels"], where=str(folder / SETTINGS_FILE))
    except (KeyError, TypeError):
        raise InputError(f"{folder}: is no label store; `improvo label SEQUENCE... -o LABELS` makes one") from None
    done = [record for record in records if record.state == DONE]
    if not done:
        raise InputError(f"{folder}: has no labelled sequence; see the reasons with `improvo label`, and run it again")
    return [LabeledSequence(folder / record.name, record, settings, rule) for record in done]
