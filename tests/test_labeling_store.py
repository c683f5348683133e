"""The label store's folder: atomic, resumable, one set of settings; packed frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from improvo.errors import ConfigError, InputError, OutputError
from improvo.folder_lock import claimed
from improvo.labeling import frames as frames_module
from improvo.labeling.frames import FramesTable, PackedImages, pack_images, read_frames, write_frames
from improvo.labeling.store import (
    DONE,
    FAILED,
    LabelStore,
    SequenceRecord,
    finish_sequence,
    lock_of,
    read_records,
    sequence_names,
)

SETTINGS = {"frontend": {"name": "orb", "max_keypoints": 500}, "seed": 0}


def is_done(store: LabelStore, name: str) -> bool:
    return name in {record.name for record in store.records() if record.state == DONE}


def finish(store: LabelStore, name: str) -> None:
    folder = store.partial(name)
    folder.mkdir()
    (folder / "tracks.parquet").write_text("rows")
    finish_sequence(store.folder, SequenceRecord(name, f"/recordings/{name}", DONE, stable=3))
    store.refresh_manifest()


def test_a_sequence_appears_when_it_is_complete(tmp_path):
    store = LabelStore(tmp_path / "labels", SETTINGS)
    folder = store.partial("kitchen")
    folder.mkdir()
    assert not is_done(store, "kitchen")
    finish(store, "kitchen")
    assert is_done(store, "kitchen")
    assert (tmp_path / "labels" / "kitchen" / "tracks.parquet").is_file()
    assert pq.read_table(tmp_path / "labels" / "manifest.parquet").to_pylist()[0]["stable"] == 3


def test_failures_are_kept_with_their_reason_until_they_succeed(tmp_path):
    store = LabelStore(tmp_path / "labels", SETTINGS)
    store.partial("dark").mkdir()
    store.fail(SequenceRecord("dark", "/recordings/dark", FAILED, reason="black frames"))
    assert [(record.state, record.reason) for record in store.records()] == [(FAILED, "black frames")]
    assert not is_done(store, "dark")
    finish(store, "dark")
    assert [record.state for record in store.records()] == [DONE]


def test_what_a_killed_run_left_is_cleared_away(tmp_path):
    store = LabelStore(tmp_path / "labels", SETTINGS)
    finish(store, "done")
    leftover = store.partial("half")
    leftover.mkdir()
    (leftover / "label.json").write_text("{")
    again = LabelStore(tmp_path / "labels", SETTINGS)
    assert not leftover.exists()
    assert is_done(again, "done")
    assert [record.name for record in again.records()] == ["done"]


def test_other_settings_are_refused_or_start_anew(tmp_path):
    finish(LabelStore(tmp_path / "labels", SETTINGS), "kitchen")
    other = {**SETTINGS, "frontend": {"name": "orb", "max_keypoints": 600}}
    with pytest.raises(ConfigError, match=r"frontend\.max_keypoints=500, now 600; .*--relabel"):
        LabelStore(tmp_path / "labels", other)
    assert is_done(LabelStore(tmp_path / "labels", SETTINGS), "kitchen")
    assert not is_done(LabelStore(tmp_path / "labels", other, relabel=True), "kitchen")


def test_a_folder_that_is_not_ours_is_refused(tmp_path):
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(OutputError, match="did not write"):
        LabelStore(tmp_path, SETTINGS)


def test_damaged_records_and_missing_stores_are_one_line_errors(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        read_records(tmp_path / "nowhere")
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "label.json").write_text("{}")
    with pytest.raises(InputError, match="damaged"):
        read_records(tmp_path)


def test_names_are_unique_and_the_same_each_time(tmp_path):
    for name in ("one/rgb", "two/rgb", "three"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "walk.mp4").write_text("")
    paths = [tmp_path / name for name in ("one/rgb", "two/rgb", "three", "walk.mp4")]
    names = sequence_names(paths)
    assert list(names) == ["rgb", "two-rgb", "three", "walk"]
    assert sequence_names(paths) == names
    with pytest.raises(InputError, match="given twice"):
        sequence_names([paths[0], paths[1].parent / ".." / "one" / "rgb"])


def test_names_differ_where_a_file_system_knows_no_case(tmp_path):
    for name in ("one/Walk", "two/walk", "three/WALK"):
        (tmp_path / name).mkdir(parents=True)
    first, second, third = (tmp_path / name for name in ("one/Walk", "two/walk", "three/WALK"))
    assert list(sequence_names([first, second])) == ["Walk", "two-walk"]
    stored = [SequenceRecord("Walk", str(first), DONE)]
    assert sequence_names([third, first], stored) == {"three-WALK": third, "Walk": first}


def test_a_recording_may_be_called_as_what_is_in_work(tmp_path):
    store = LabelStore(tmp_path / "labels", SETTINGS)
    finish(store, "walk.partial")
    store.partial("attic").mkdir()
    (tmp_path / "labels" / ".attic.partial" / "label.json").write_text("{}")  # of a killed run
    assert [record.name for record in store.records()] == ["walk.partial"]


def test_recordings_of_a_store_keep_their_names_in_any_list(tmp_path):
    """Many recordings are folders named `images`; a store grows by some of them at a time."""
    folders = [tmp_path / name / "images" for name in ("a", "b", "c")]
    for folder in folders:
        folder.mkdir(parents=True)
    first, second, third = folders
    stored = [SequenceRecord(name, str(path), DONE) for name, path in sequence_names([first, second]).items()]
    assert [record.name for record in stored] == ["images", "b-images"]
    assert sequence_names([second, first], stored) == {"b-images": second, "images": first}
    assert sequence_names([second], stored) == {"b-images": second}
    assert sequence_names([third], stored) == {"c-images": third}
    assert sequence_names([third, first, second], stored) == {"c-images": third, "images": first, "b-images": second}
    failed = [SequenceRecord("images", str(first), FAILED, "no camera")]
    assert sequence_names([second, first], failed) == {"b-images": second, "images": first}
    first.rename(tmp_path / "moved")
    with pytest.raises(InputError, match=r"named images of .*, where there is none any more; if it has moved"):
        sequence_names([third], stored)


def test_frames_round_trip(tmp_path):
    frames = FramesTable(
        frame=np.arange(4),
        source_index=np.arange(4) * 3,
        time=np.arange(4) / 7,
        segment=np.array([-1, 0, 0, 1]),
        trusted=np.array([False, True, True, False]),
    )
    write_frames(tmp_path / "frames.parquet", frames)
    table = read_frames(tmp_path / "frames.parquet")
    for name in FramesTable.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(table, name), getattr(frames, name))
    with pytest.raises(InputError, match="no such file"):
        read_frames(tmp_path / "nothing.parquet")


def test_packed_frames_come_back_in_any_order(tmp_path, monkeypatch):
    monkeypatch.setattr(frames_module, "_FRAMES_PER_SHARD", 8)
    monkeypatch.setattr(frames_module, "_FRAMES_PER_GROUP", 4)
    rows, columns = np.mgrid[:48, :64]
    pictures = [((rows + columns + 5 * i) % 200).astype(np.uint8) for i in range(19)]
    masks = [(columns > i) if i % 5 else None for i in range(19)]
    assert pack_images(tmp_path, zip(pictures, masks, strict=True)) == 19
    assert len(list(tmp_path.glob("images-*.parquet"))) == 3
    packed = PackedImages(tmp_path)
    for frame in (0, 18, 7, 8, 3, 16):
        difference = np.abs(packed.image(frame).astype(int) - pictures[frame])
        assert np.median(difference) <= 2
        mask = packed.mask(frame)
        assert mask is None if masks[frame] is None else np.array_equal(mask, masks[frame])
    with pytest.raises(InputError, match="--pack"):
        PackedImages(Path(tmp_path / "elsewhere"))


def test_a_killed_run_leaves_no_temporary_file_and_no_doubt(tmp_path):
    folder = tmp_path / "labels"
    folder.mkdir()
    (folder / "..improvo.json.123.partial.json").write_text("{")  # killed before the folder was marked as ours
    store = LabelStore(folder, SETTINGS)
    finish(store, "kitchen")
    (folder / ".manifest.parquet.123.partial.parquet").write_text("PAR1")
    store.fail(SequenceRecord("hall", "/recordings/hall", FAILED, reason="dark"))
    (folder / ".kitchen.failed.json").write_text((folder / ".hall.failed.json").read_text().replace("hall", "kitchen"))
    again = LabelStore(folder, SETTINGS)
    assert not list(folder.glob("*.partial*"))
    assert [(record.name, record.state) for record in again.records()] == [("hall", FAILED), ("kitchen", DONE)]


def test_relabelling_never_leaves_half_a_sequence(tmp_path, monkeypatch):
    folder = tmp_path / "labels"
    finish(LabelStore(folder, SETTINGS), "kitchen")

    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("improvo.labeling.store.make_output_folder", killed)
    with pytest.raises(KeyboardInterrupt):
        LabelStore(folder, {**SETTINGS, "seed": 1}, relabel=True)
    monkeypatch.undo()
    assert not is_done(LabelStore(folder, SETTINGS), "kitchen")
    assert not (folder / "kitchen").exists()


def test_a_manifest_that_cannot_be_written_is_no_failure_of_a_sequence(tmp_path, monkeypatch):
    store = LabelStore(tmp_path / "labels", SETTINGS)

    def full(*_: object) -> None:
        raise OutputError("no space")

    monkeypatch.setattr(store, "write_manifest", full)
    finish(store, "kitchen")
    assert is_done(store, "kitchen")


def test_other_settings_may_follow_where_nothing_could_be_labelled(tmp_path: Path) -> None:
    store = LabelStore(tmp_path / "labels", SETTINGS)
    store.fail(SequenceRecord("kitchen", "/recordings/kitchen", FAILED, reason="a mask of another size"))
    other = {**SETTINGS, "seed": 1}
    with claimed(lock_of(store.folder, "kitchen"), store.folder), pytest.raises(ConfigError, match="was begun with"):
        LabelStore(tmp_path / "labels", other)  # somebody is at work on it
    again = LabelStore(tmp_path / "labels", other)
    assert again.records() == []
    finish(again, "kitchen")
    with pytest.raises(ConfigError, match="was begun with"):
        LabelStore(tmp_path / "labels", SETTINGS)
