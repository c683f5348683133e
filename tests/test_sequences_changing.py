"""A recording that changes while it is read: what can no longer be read is left out and named, the rest goes on."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered_walk import write_walk

import sequence_encoders as encoders
from fuzz_targets import scene
from improvo.sequences import open_recording, open_sequence
from improvo.sequences.content import content_of, depth_content
from sequence_builders import images, write_video

FRAMES = 8
Change = Callable[[Path], object]


def pictures(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.png"))


def halve(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def another_size(folder: Path) -> None:
    cv2.imwrite(str(pictures(folder)[4]), np.zeros((10, 20), np.uint8))


def write_avi(path: Path) -> None:
    write_video(path, images(FRAMES))


def read_while_it_changes(path: Path, change: Change) -> tuple[list[int], dict[int, str]]:
    """Frames that were read, and why others were not."""
    sequence = open_sequence(path, camera="90,91,47,36.5")
    assert len(sequence) == FRAMES
    found = []
    for frame in sequence:
        assert frame.image.shape == (72, 96)
        found.append(frame.source_index)
        if len(found) == 2:
            change(path)
    return found, {skipped.index: skipped.reason for skipped in sequence.skipped}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda folder: pictures(folder)[4].unlink(), "No such file"),
        (lambda folder: halve(pictures(folder)[4]), ""),
        (another_size, "is 20x10 in a recording of 96x72"),
    ],
)
def test_a_picture_that_goes_away_or_becomes_another(tmp_path: Path, change: Change, words: str) -> None:
    encoders.write_image_folder(tmp_path / "folder", scene(FRAMES))
    found, skipped = read_while_it_changes(tmp_path / "folder", change)
    assert found == [0, 1, 2, 3, 5, 6, 7]
    assert list(skipped) == [4]
    assert words in skipped[4]


def test_a_folder_that_goes_away(tmp_path: Path) -> None:
    encoders.write_image_folder(tmp_path / "folder", scene(FRAMES))
    found, skipped = read_while_it_changes(
        tmp_path / "folder", lambda folder: [path.unlink() for path in pictures(folder)]
    )
    assert sorted([*found, *skipped]) == list(range(FRAMES))
    assert len(skipped) >= FRAMES - 3  # one may have been read ahead


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("s.sens", lambda path: encoders.write_sens(path, scene(FRAMES))),
        ("s.r3d", lambda path: encoders.write_r3d(path, scene(FRAMES))),
        ("v.avi", write_avi),
    ],
)
def test_a_file_that_is_cut_short(tmp_path: Path, name: str, write: Change) -> None:
    write(tmp_path / name)
    found, skipped = read_while_it_changes(tmp_path / name, halve)
    assert sorted([*found, *skipped]) == list(range(FRAMES))
    assert all(skipped.values())


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_a_bag_that_is_cut_short(tmp_path: Path, storage: str) -> None:
    pytest.importorskip("rosbags", reason="needs the extra `ros`")
    import ros_encoders

    bag = ros_encoders.write_bag(tmp_path / "bag", scene(FRAMES), 2, storage=storage)
    content = next(path for path in bag.iterdir() if path.suffix in (".db3", ".mcap"))
    found, skipped = read_while_it_changes(bag, lambda _: os.truncate(content, 4096))
    assert sorted([*found, *skipped]) == list(range(FRAMES))


def test_a_file_that_is_written_over(tmp_path: Path) -> None:
    encoders.write_sens(tmp_path / "s.sens", scene(FRAMES))
    found, skipped = read_while_it_changes(
        tmp_path / "s.sens", lambda path: path.write_bytes(bytes(path.stat().st_size))
    )
    assert sorted([*found, *skipped]) == list(range(FRAMES))
    assert "not a readable image" in skipped.values()


def test_what_is_in_a_recording_is_told_wherever_it_lies(tmp_path: Path) -> None:
    def content(path: Path) -> str:
        return content_of(open_recording(path))

    first, other = (write_walk(tmp_path / name, frames=7, seed=seed) for seed, name in enumerate(("a", "b")))
    copy = tmp_path / "copy"
    shutil.copytree(first, copy)
    assert content(first) == content(copy) != content(other)
    edited = copy / "000002.png"  # none of those that are decoded
    cv2.imwrite(str(edited), 255 - cv2.imread(str(edited)))
    assert content(copy) != content(first)
    videos = []
    for name, turned in (("one.mp4", 1), ("same.mp4", 1), ("two.mp4", -1)):
        writer = cv2.VideoWriter(str(tmp_path / name), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (320, 240))
        for picture in sorted(first.glob("*.png")):
            writer.write(cv2.imread(str(picture))[::turned])
        writer.release()
        videos.append(content(tmp_path / name))
    assert videos[0] == videos[1] != videos[2]


def test_what_is_in_the_pictures_of_a_list_counts_with_the_list(tmp_path: Path) -> None:
    file = encoders.write_transforms(tmp_path, scene(FRAMES)) / "transforms.json"
    before = content_of(open_recording(file))
    assert content_of(open_recording(file)) == before
    picture = open_recording(file).source(FRAMES // 2)
    cv2.imwrite(picture, 255 - cv2.imread(picture))
    assert content_of(open_recording(file)) != before


def test_depth_is_told_beside_the_pictures(tmp_path: Path) -> None:
    encoders.write_tum(tmp_path / "room", scene(FRAMES))
    shutil.copytree(tmp_path / "room", tmp_path / "copy")
    before, same = (open_recording(tmp_path / name) for name in ("room", "copy"))
    assert depth_content(before) == depth_content(same)
    edited = sorted((tmp_path / "copy" / "depth").iterdir())[5]
    cv2.imwrite(str(edited), cv2.imread(str(edited), cv2.IMREAD_UNCHANGED) + 1)
    after = open_recording(tmp_path / "copy")
    told = [depth_content(before), depth_content(after)]
    assert content_of(after) == content_of(before)  # labels and features do not depend on it
    edited.unlink()
    assert len({*told, depth_content(after)}) == 3
    encoders.write_image_folder(tmp_path / "without", scene(FRAMES))
    assert depth_content(open_recording(tmp_path / "without"))
