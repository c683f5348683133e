"""Labeled sequences opened when drawn: the batches of a training that holds everything, in bounded memory."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs the extra `train`")

from improvo.errors import InputError
from improvo.labeling.labeled import LabeledSequence, read_labels
from improvo.training.batches.tracked_pairs import TrackedPairs
from improvo.training.data import landmark_files
from improvo.training.data.label_library import SPARE, LabelLibrary
from improvo.training.data.labeled_frames import LabeledFrames
from improvo.training.settings import (
    LandmarkSettings,
    OdometryTrainingSettings,
    OptimiserSettings,
    PairSettings,
    ViewSettings,
)
from labeled_scene import write_labeled_scene

SETTINGS = OdometryTrainingSettings(
    longer_side=160,
    pairs=PairSettings(points=48, stability_points=60),
    optimiser=OptimiserSettings(steps=8, batch_size=6),
    views=ViewSettings(height=72, width=96),
)


@pytest.fixture
def sequences(tmp_path: Path) -> list[LabeledSequence]:
    """Three sequences, each in a store of its own."""
    noises = {"first": 0.0, "second": 0.3, "third": 0.6}
    stores = [write_labeled_scene(tmp_path / name, name, keypoint_noise=noise) for name, noise in noises.items()]
    return [read_labels(store)[0] for store in stores]


def library(sequences: list[LabeledSequence], output: Path, memory_mib: int = 1, workers: int = 1) -> LabelLibrary:
    return LabelLibrary(sequences, SETTINGS.longer_side, SETTINGS.landmarks, output, memory_mib, workers)


def files_of(sequence: LabeledSequence) -> list[Path]:
    return sorted(sequence.folder.glob("landmarks-*"))


def assert_same_batches(found: TrackedPairs, expected: TrackedPairs) -> None:
    assert found.stable_per_unstable == expected.stable_per_unstable
    for step in range(SETTINGS.optimiser.steps):
        a, b = found[step], expected[step]
        assert a.keys() == b.keys()
        for name, values in a.items():
            assert values.dtype == b[name].dtype
            assert np.array_equal(values, b[name]), (step, name)


def test_batches_are_those_of_a_training_that_holds_everything_in_memory(
    sequences: list[LabeledSequence], tmp_path: Path
) -> None:
    held = [LabeledFrames(sequence, SETTINGS.longer_side, SETTINGS.landmarks) for sequence in sequences]
    expected = TrackedPairs(held, SETTINGS)
    first = library(sequences, tmp_path / "out")
    assert [len(files_of(sequence)) for sequence in sequences] == [1, 1, 1]
    assert_same_batches(TrackedPairs(first, SETTINGS), expected)
    assert len(first._open) == 1  # a megabyte has room for no more
    again = library(sequences, tmp_path / "out", memory_mib=1000)
    assert_same_batches(TrackedPairs(again, SETTINGS), expected)
    assert len(again._open) == 3
    copied = pickle.loads(pickle.dumps(TrackedPairs(again, SETTINGS)))  # as a process that makes batches gets it
    assert not copied.sequences._open
    assert_same_batches(copied, expected)


def test_files_are_made_once_and_by_whom_does_not_matter(
    sequences: list[LabeledSequence], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("improvo.training.data.label_library._ENOUGH_FOR_PROCESSES", 1)
    library(sequences, tmp_path / "out", workers=2)
    made = [files_of(sequence)[0].read_bytes() for sequence in sequences]
    monkeypatch.setattr(landmark_files, "find_landmarks", None)  # would fail
    found = library(sequences, tmp_path / "out")
    assert len(found[2]) == 40
    monkeypatch.undo()
    for sequence, before in zip(sequences, made, strict=True):
        files_of(sequence)[0].unlink()
        library([sequence], tmp_path / "out")
        assert files_of(sequence)[0].read_bytes() == before


def test_other_landmarks_have_files_of_their_own(sequences: list[LabeledSequence], tmp_path: Path) -> None:
    library(sequences[:1], tmp_path / "out")
    LabelLibrary(sequences[:1], 160, LandmarkSettings(shared=False), tmp_path / "out", 1)
    assert len(files_of(sequences[0])) == 2
    LabelLibrary(sequences[:1], 160, LandmarkSettings(unseen=False), tmp_path / "out", 1)  # only how they are used
    assert len(files_of(sequences[0])) == 2


@pytest.mark.parametrize("damage", ["cut", "overwritten", "other labels", "wild index"])
def test_a_file_that_is_not_right_is_made_anew(sequences: list[LabeledSequence], tmp_path: Path, damage: str) -> None:
    expected = library(sequences, tmp_path / "out")
    file = files_of(sequences[0])[0]
    right = file.read_bytes()
    if damage == "cut":
        file.write_bytes(right[: len(right) // 2])
    elif damage == "overwritten":
        file.write_bytes(bytes(len(right)))
    elif damage == "other labels":
        file.write_bytes(files_of(sequences[1])[0].read_bytes())
    else:
        landmark = expected[0].landmarks.landmark.tobytes()
        file.write_bytes(right.replace(landmark, np.full(len(landmark) // 4, 1 << 30, np.int32).tobytes()))
        assert file.read_bytes() != right
    found = library(sequences, tmp_path / "out")
    assert np.array_equal(found[0].points(7).points, expected[0].points(7).points)
    assert file.read_bytes() == right


def test_files_of_a_store_that_cannot_be_written_lie_with_the_training(
    sequences: list[LabeledSequence], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = landmark_files.written_atomically

    def refuse_store(path: Path) -> object:
        from improvo.errors import OutputError

        if path.parent == sequences[0].folder:
            raise OutputError(f"{path}: cannot be written")
        return real(path)

    monkeypatch.setattr(landmark_files, "written_atomically", refuse_store)
    found = library(sequences[:1], tmp_path / "out")
    assert not files_of(sequences[0])
    assert len(list((tmp_path / "out" / SPARE).iterdir())) == 1
    monkeypatch.setattr(landmark_files, "find_landmarks", None)
    again = library(sequences[:1], tmp_path / "out")
    assert np.array_equal(again[0].points(7).points, found[0].points(7).points)


def test_damaged_tables_are_named(sequences: list[LabeledSequence], tmp_path: Path) -> None:
    (sequences[1].folder / "tracks.parquet").write_bytes(b"PAR1")
    with pytest.raises(InputError, match=r"tracks\.parquet: cannot be read"):
        library(copy.copy(sequences), tmp_path / "out")
