"""What is held back: whole sequences, or the end of one; never a frame that is trained on."""

from __future__ import annotations

from pathlib import Path

import pytest
from rendered_walk import write_walk

from improvo.errors import InputError
from improvo.improvement.split import (
    remembered_split,
    share_labels,
    split_as_named,
    split_last_part,
    split_whole_sequences,
)
from improvo.labeling.store import DONE, FAILED, SequenceRecord, read_records
from improvo.sequences import SequenceSettings, open_sequence


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walk(tmp_path_factory.mktemp("walk") / "images", frames=30)


def records(count: int, failed: tuple[int, ...] = ()) -> list[SequenceRecord]:
    return [
        SequenceRecord(f"s{i}", f"/recordings/s{i}", FAILED if i in failed else DONE, "black" if i in failed else "")
        for i in range(count)
    ]


@pytest.mark.parametrize(
    "how",
    [
        SequenceSettings(),
        SequenceSettings(start=3, stride=2),
        SequenceSettings(start=1, stride=3, max_frames=8),
        SequenceSettings(end=25),
    ],
)
def test_the_last_part_of_one_recording_is_the_rest_of_what_is_trained_on(walk: Path, how: SequenceSettings) -> None:
    split = split_last_part(walk, how, 0.2)
    training = open_sequence(walk, split.training.sequence).indices.tolist()
    held_back = open_sequence(walk, split.held_back.sequence).indices.tolist()
    assert training + held_back == open_sequence(walk, how).indices.tolist()
    assert len(held_back) == max(3, round(0.2 * len(training + held_back)))
    assert split.words.startswith(f"the last {len(held_back)} of ")


def test_a_recording_that_is_too_short_is_refused(walk: Path) -> None:
    with pytest.raises(InputError, match=r"has 5 frames, too few .* give a longer recording"):
        split_last_part(walk, SequenceSettings(end=5), 0.2)


@pytest.mark.parametrize(
    ("count", "share", "expected"),
    [(2, 0.2, [1]), (5, 0.2, [4]), (10, 0.2, [4, 9]), (3, 0.9, [1, 2]), (11, 0.2, [5, 10])],
)
def test_one_sequence_in_five_is_held_back_and_never_the_first(count: int, share: float, expected: list[int]) -> None:
    split = split_whole_sequences(records(count), SequenceSettings(), share)
    assert [int(path.name[1:]) for path in split.held_back.paths] == expected
    assert len(split.training.paths) == count - len(expected)
    assert not set(split.training.paths) & set(split.held_back.paths)
    assert split.training.sequence == split.held_back.sequence


def test_what_has_no_labels_is_in_neither_part(walk: Path) -> None:
    split = split_whole_sequences(records(4, failed=(3, 1)), SequenceSettings(), 0.2)
    assert [path.name for path in split.training.paths] == ["s0"]
    assert [path.name for path in split.held_back.paths] == ["s2"]
    assert split.unusable == ("s1: black", "s3: black")
    only = [SequenceRecord("walk", str(walk), DONE), *records(2, failed=(0, 1))]
    split = split_whole_sequences(only, SequenceSettings(), 0.2)
    assert split.training.paths == split.held_back.paths == (walk,)
    assert split.training.sequence.end == split.held_back.sequence.start == 24
    assert len(split.unusable) == 2


def test_what_the_user_names_is_not_trained_on(tmp_path: Path) -> None:
    a, b, c = (tmp_path / name for name in "abc")
    split = split_as_named([a, b], [b, c], SequenceSettings())
    assert split.training.paths == (a,)
    assert split.held_back.paths == (b, c)
    with pytest.raises(InputError, match="leave some to train on"):
        split_as_named([a], [a], SequenceSettings())


def test_the_split_is_made_once(walk: Path, tmp_path: Path) -> None:
    made = remembered_split(tmp_path / "split.json", lambda: split_last_part(walk, SequenceSettings(stride=2), 0.3))
    assert remembered_split(tmp_path / "split.json", lambda: pytest.fail("made again")) == made


def test_shared_labels_keep_their_content_and_get_the_name_of_the_new_store(tmp_path: Path) -> None:
    survey = tmp_path / "survey"
    both = [
        SequenceRecord("take", str(tmp_path / "day" / "take"), DONE, stable=3),
        SequenceRecord("night-take", str(tmp_path / "night" / "take"), DONE, stable=4),
    ]
    for record in both:
        (survey / record.name).mkdir(parents=True)
        (survey / record.name / "points.parquet").write_text(record.path)
        (survey / record.name / "label.json").write_text("{}")
    for name in (".improvo.json", "settings.yaml"):
        (survey / name).write_text("{}")
    held_back = split_as_named([Path(both[0].path)], [Path(both[1].path)], SequenceSettings()).held_back
    for _ in range(2):  # again, as after a kill: nothing changes
        share_labels(survey, both, held_back, tmp_path / "held-back")
        (found,) = read_records(tmp_path / "held-back")
        assert (found.name, found.path, found.stable) == ("take", both[1].path, 4)
        assert (tmp_path / "held-back" / "take" / "points.parquet").read_text() == both[1].path
    assert (survey / "night-take" / "label.json").read_text() == "{}"
