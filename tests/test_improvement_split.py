"""What is held back: whole sequences, or the end of one; never a frame that is trained on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from rendered_walk import write_walk

from improvo.errors import ConfigError, InputError
from improvo.improvement.plan import first_estimate
from improvo.improvement.settings import ImproveSettings, SplitSettings
from improvo.improvement.split import (
    frames_there,
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
    split = split_last_part(walk, how, SplitSettings(0.2))
    training = open_sequence(walk, split.training.sequence).indices.tolist()
    held_back = open_sequence(walk, split.held_back.sequence).indices.tolist()
    assert training + held_back == open_sequence(walk, how).indices.tolist()
    assert len(held_back) == max(3, round(0.2 * len(training + held_back)))
    assert split.words.startswith(f"the last {len(held_back)} of ")


def test_a_recording_that_is_too_short_is_refused(walk: Path) -> None:
    with pytest.raises(InputError, match=r"has 5 frames, too few .* give a longer recording"):
        split_last_part(walk, SequenceSettings(end=5), SplitSettings(0.2))


@pytest.mark.parametrize(
    ("frames", "held_back"), [(10_000, 2000), (600, 120), (300, 60), (240, 60), (180, 60), (150, 50), (100, 33), (9, 3)]
)
def test_a_fifth_is_held_back_but_sixty_frames_of_a_short_recording_and_never_more_than_a_third(
    frames: int, held_back: int
) -> None:
    assert SplitSettings().frames_of_one(frames) == held_back
    assert SplitSettings(least_frames=0).frames_of_one(frames) == round(frames / 5)
    assert SplitSettings(share=0.2).frames_of_one(frames) == round(frames / 5)  # as the user says
    assert SplitSettings(share=0.5).frames_of_one(frames) == round(frames / 2)


def test_impossible_splits_are_refused() -> None:
    for wrong in (0.0, 1.0, -0.1):
        with pytest.raises(ConfigError, match=r"split\.share=.* between 0 and 1"):
            SplitSettings(share=wrong)
    with pytest.raises(ConfigError, match=r"split\.least_frames=-1"):
        SplitSettings(least_frames=-1)


def test_by_default_a_third_of_half_a_second_is_held_back(walk: Path) -> None:
    split = split_last_part(walk, SequenceSettings(), SplitSettings())
    assert split.words == f"the last 10 of 30 frames of {walk.name}"
    assert (split.training.sequence.end, split.held_back.sequence.start) == (20, 20)


def test_pictures_that_are_named_but_absent_do_not_count(walk: Path, tmp_path: Path) -> None:
    """A list of 90 pictures, of which the first, two in the middle and the last 60 are not there."""
    copy = tmp_path / "copy"
    (copy / "rgb").mkdir(parents=True)
    pictures = sorted(walk.glob("*.png"))
    assert len(pictures) == 30
    names = [f"rgb/{row:04d}.png" for row in range(90)]
    for row in sorted(set(range(30)) - {0, 10, 11}):
        (copy / names[row]).write_bytes(pictures[row].read_bytes())
    (copy / "rgb.txt").write_text("".join(f"{row / 30:.6f} {name}\n" for row, name in enumerate(names)))
    how = SequenceSettings(camera="300,300,160,120")
    opened = open_sequence(copy, how)
    assert (opened.format, len(opened), len(opened.present)) == ("tum", 90, 27)
    assert frames_there(copy, how) == 27
    split = split_last_part(copy, how, SplitSettings())
    assert split.words == "the last 9 of 27 frames of copy (of 90 that it lists)"
    training, held_back = (open_sequence(copy, part.sequence) for part in (split.training, split.held_back))
    assert training.present.tolist() == [*range(1, 10), *range(12, 21)]
    assert held_back.indices.tolist() == held_back.present.tolist() == list(range(21, 30))
    assert frames_there(copy, replace(how, stride=2)) == 13
    _, needed = first_estimate([copy], ImproveSettings(sequence=how), rounds=1)
    assert needed is not None
    assert needed.labeled_frames == 27 + 2 * 9  # what is held back again, by the start and by the round


@pytest.mark.parametrize(
    ("count", "share", "expected"),
    [(2, 0.2, [1]), (5, 0.2, [4]), (10, 0.2, [4, 9]), (3, 0.9, [1, 2]), (11, 0.2, [5, 10])],
)
def test_one_sequence_in_five_is_held_back_and_never_the_first(count: int, share: float, expected: list[int]) -> None:
    split = split_whole_sequences(records(count), SequenceSettings(), SplitSettings(share))
    assert [int(path.name[1:]) for path in split.held_back.paths] == expected
    assert len(split.training.paths) == count - len(expected)
    assert not set(split.training.paths) & set(split.held_back.paths)
    assert split.training.sequence == split.held_back.sequence


def test_what_has_no_labels_is_in_neither_part(walk: Path) -> None:
    split = split_whole_sequences(records(4, failed=(3, 1)), SequenceSettings(), SplitSettings(0.2))
    assert [path.name for path in split.training.paths] == ["s0"]
    assert [path.name for path in split.held_back.paths] == ["s2"]
    assert split.unusable == ("s1: black", "s3: black")
    only = [SequenceRecord("walk", str(walk), DONE), *records(2, failed=(0, 1))]
    split = split_whole_sequences(only, SequenceSettings(), SplitSettings(0.2))
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
    made = remembered_split(
        tmp_path / "split.json", lambda: split_last_part(walk, SequenceSettings(stride=2), SplitSettings(0.3))
    )
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
