"""Readers of other packages, through the entry point."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

from improvo.errors import ConfigError, InputError
from improvo.geometry.camera_files import Calibration
from improvo.sequences import Recording, SequenceSettings, open_sequence, opening
from improvo.sequences.base import UnreadableFrameError
from improvo.types import UInt8


class NumpyStack(Recording):
    """The example of docs/recordings.md."""

    format = "stack"

    def __init__(self, path: Path, settings: SequenceSettings) -> None:
        self.path = path
        self._images = np.load(path, mmap_mode="r", allow_pickle=False)
        self.times = np.arange(len(self._images)) / (settings.fps or 30.0)
        self.calibration = Calibration(str(path), (60.0, 60.0, 15.5, 11.5))

    @classmethod
    def recognises(cls, path: Path) -> bool:
        return path.suffix == ".npy"

    def source(self, index: int) -> str:
        return f"{self.path}#{index}"

    def image(self, index: int) -> UInt8:
        if not self._images[index].any():
            raise UnreadableFrameError("the frame is empty")
        return np.array(self._images[index])


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    points = {
        "stack": EntryPoint("stack", f"{__name__}:NumpyStack", opening.ENTRY_POINT),
        "missing": EntryPoint("missing", "no_such_package:Reader", opening.ENTRY_POINT),
        "wrong": EntryPoint("wrong", "pathlib:Path", opening.ENTRY_POINT),
    }
    monkeypatch.setattr(opening, "_installed", lambda: points)


@pytest.fixture
def only_stack(monkeypatch: pytest.MonkeyPatch) -> None:
    point = EntryPoint("stack", f"{__name__}:NumpyStack", opening.ENTRY_POINT)
    monkeypatch.setattr(opening, "_installed", lambda: {"stack": point})


@pytest.mark.usefixtures("only_stack")
def test_own_reader_is_recognised_and_read(tmp_path: Path) -> None:
    stack = np.random.default_rng(0).integers(1, 255, (5, 24, 32), np.uint8)
    stack[3] = 0
    np.save(tmp_path / "s.npy", stack)
    sequence = open_sequence(tmp_path / "s.npy", stride=1)
    assert sequence.format == "stack"
    assert [frame.source_index for frame in sequence] == [0, 1, 2, 4]
    assert (sequence[4].image == stack[4]).all()
    assert sequence.skipped[0].reason == "the frame is empty"
    assert (sequence.camera.width, sequence.camera.fx) == (32, 60.0)


@pytest.mark.usefixtures("installed")
def test_readers_that_cannot_be_used_are_one_line_errors(tmp_path: Path) -> None:
    (tmp_path / "s.npy").write_bytes(b"")
    with pytest.raises(InputError, match=r"reader `missing` .* cannot be imported"):
        open_sequence(tmp_path / "s.npy", format="missing")
    with pytest.raises(InputError, match=r"pathlib:Path: must be a subclass"):
        open_sequence(tmp_path / "s.npy", format="wrong")
    with pytest.raises(ConfigError, match="known: auto, stack, missing, wrong, live"):
        open_sequence(tmp_path / "s.npy", format="nothing")


def test_the_group_is_the_documented_one() -> None:
    assert opening.ENTRY_POINT == "improvo.recordings"
    assert opening._installed() == {}
