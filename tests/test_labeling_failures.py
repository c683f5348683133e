"""What goes wrong while labels are made or read: one sequence fails with its reason, the rest of the store stays."""

from __future__ import annotations

import errno
import logging
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from rendered_walk import write_walk

from improvo.errors import InputError, OutputError
from improvo.labeling import label_job as labeling
from improvo.labeling.frames import FramesTable, PackedImages, pack_images, read_frames, write_frames
from improvo.labeling.label_sequences import fingerprint, label_sequences
from improvo.labeling.store import DONE, FAILED, LabelStore, read_records
from improvo.odometry.run_settings import RunSettings

PICTURES = [np.full((48, 64), 10 * i, np.uint8) for i in range(5)]


def settings() -> RunSettings:
    base = RunSettings()
    labels = replace(base.labels, min_observations=6)
    return replace(base, frontend=replace(base.frontend, name="orb", max_keypoints=300), labels=labels)


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("walks")
    return [write_walk(folder / name, frames=22, seed=seed) for seed, name in enumerate(("kitchen", "hall"))]


# --- frames


@pytest.mark.parametrize(("frame", "index"), [([0, 1, 2], [5, 5, 6]), ([0, 1, 2], [9, 5, 6]), ([0, 2, 1], [4, 5, 6])])
def test_frames_out_of_order_are_refused(tmp_path: Path, frame: list[int], index: list[int]) -> None:
    table = FramesTable(
        np.array(frame), np.array(index), np.arange(3) / 30, np.zeros(3, np.int64), np.ones(3, np.bool_)
    )
    write_frames(tmp_path / "frames.parquet", table)
    with pytest.raises(InputError, match=r"frames\.parquet: its frames are out of order; run `improvo label` again"):
        read_frames(tmp_path / "frames.parquet")


def test_packed_frames_that_were_damaged_are_named(tmp_path: Path) -> None:
    pack_images(tmp_path, ((picture, None) for picture in PICTURES))
    shard = tmp_path / "images-00000.parquet"
    table = pq.read_table(shard)
    pictures = table["jpeg"].to_pylist()
    pictures[2], pictures[3] = b"no picture", pictures[3][:20]
    pq.write_table(table.set_column(1, "jpeg", pa.array(pictures, pa.binary())), shard)
    packed = PackedImages(tmp_path)
    assert np.abs(packed.image(4).astype(int) - PICTURES[4]).max() <= 2
    for frame in (2, 3):
        with pytest.raises(InputError, match=rf"images-00000\.parquet: frame {frame} cannot be read .*label it again"):
            packed.image(frame)
    with pytest.raises(InputError, match=r"images-00000\.parquet: cannot be read .*label it again"):
        packed.image(77)
    shard.write_bytes(shard.read_bytes()[:-9])
    with pytest.raises(InputError, match=r"images-00000\.parquet: cannot be read .*label it again"):
        PackedImages(tmp_path).image(0)


def test_packing_that_fails_in_the_middle_says_so_once(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    def pictures() -> Any:
        yield PICTURES[0], None
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        pack_images(tmp_path, pictures())
    assert capfd.readouterr().err == ""


# --- sequences


def test_a_disk_that_is_full_while_frames_are_packed_fails_that_sequence_alone(
    walks: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(folder: Path, images: Any) -> int:
        if "kitchen" in folder.name:
            raise OSError(errno.ENOSPC, "No space left on device")
        return pack_images(folder, images)

    monkeypatch.setattr(labeling, "pack_images", full)
    records = label_sequences(walks, tmp_path / "labels", settings(), pack=True)
    assert [record.state for record in records] == [FAILED, DONE]
    assert "the frames cannot be packed" in records[0].reason
    assert "choose another folder" in records[0].reason
    monkeypatch.undo()
    again = label_sequences(walks, tmp_path / "labels", settings(), pack=True)
    assert [record.state for record in again] == [DONE, DONE]
    assert not list((tmp_path / "labels").glob(".*.partial"))


def test_a_bug_is_the_failure_of_one_sequence_and_is_logged_with_its_place(
    walks: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    real = labeling.run_and_label

    def with_bug(sequence: Any, folder: Path, *rest: Any, **more: Any) -> Any:
        if "hall" in folder.name:
            raise ZeroDivisionError("division\nby zero")
        return real(sequence, folder, *rest, **more)

    monkeypatch.setattr(labeling, "run_and_label", with_bug)
    with caplog.at_level(logging.ERROR):
        records = label_sequences(walks, tmp_path / "labels", settings())
    assert [record.state for record in records] == [DONE, FAILED]
    assert records[1].reason == f"{walks[1]}: unexpected ZeroDivisionError: division by zero"
    assert caplog.records[0].exc_info is not None


def test_a_failure_that_cannot_be_written_down_is_still_told(
    walks: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(self: LabelStore, record: Any) -> None:
        raise OutputError(f"{record.name}: cannot be written")

    monkeypatch.setattr(LabelStore, "fail", refuse)
    records = label_sequences([walks[0], tmp_path / "missing"], tmp_path / "labels", settings())
    assert [record.state for record in records] == [DONE, FAILED]
    assert "no such file or folder" in records[1].reason
    assert "missing: cannot be written" in caplog.text


def test_an_interrupt_within_a_recording_leaves_it_to_the_next_command(
    walks: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = labeling.run_and_label

    def interrupted(*words: Any, **more: Any) -> Any:
        labeled = real(*words, **more)
        return replace(labeled, report={**labeled.report, "interrupted": True})

    with monkeypatch.context() as patch:
        patch.setattr(labeling, "run_and_label", interrupted)
        with pytest.raises(KeyboardInterrupt):
            label_sequences(walks[:1], tmp_path / "labels", settings())
    assert read_records(tmp_path / "labels") == []
    assert label_sequences(walks[:1], tmp_path / "labels", settings())[0].state == DONE


def test_another_recording_of_the_same_name_gets_another_and_one_that_moved_is_refused(
    walks: list[Path], tmp_path: Path
) -> None:
    here, there = tmp_path / "kitchen", tmp_path / "elsewhere" / "kitchen"
    shutil.copytree(walks[0], here)
    shutil.copytree(walks[1], there)
    assert label_sequences([here], tmp_path / "labels", settings())[0].name == "kitchen"
    assert label_sequences([there], tmp_path / "labels", settings())[0].name == "elsewhere-kitchen"
    assert [record.state for record in read_records(tmp_path / "labels")] == [DONE, DONE]
    (tmp_path / "new").mkdir()
    here.rename(tmp_path / "new" / "kitchen")
    with pytest.raises(InputError, match="if it has moved, move it back or use another folder"):
        label_sequences([tmp_path / "new" / "kitchen"], tmp_path / "labels", settings())


def test_what_cannot_be_put_in_place_is_told(walks: list[Path], tmp_path: Path) -> None:
    """Somebody made a folder of that name."""
    store = tmp_path / "labels"
    label_sequences(walks[:1], store, settings())
    (store / "hall").mkdir()
    (store / "hall" / "mine.txt").write_text("precious")
    with pytest.raises(InputError, match=r"hall: cannot be put in place .*; remove what is there"):
        label_sequences(walks[1:], store, settings())
    assert (store / "hall" / "mine.txt").read_text() == "precious"


def test_labels_depend_on_the_content_of_a_weights_file_and_not_on_its_place(tmp_path: Path) -> None:
    def of(path: Path) -> Any:
        base = settings()
        return fingerprint(replace(base, frontend=replace(base.frontend, name=str(path))), pack=False)

    one, same, other = (tmp_path / name for name in ("a.safetensors", "b.safetensors", "c.safetensors"))
    for path, content in ((one, b"1"), (same, b"1"), (other, b"2")):
        path.write_bytes(content)
    assert of(one) == of(same) != of(other)
    assert of(one)["frontend"]["name"].startswith("sha256:")
