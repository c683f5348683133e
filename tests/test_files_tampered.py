"""Folders of ours that somebody touched, and what killed runs leave: refused in one line, or cleared away."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from improvo import files
from improvo.errors import InputError, OutputError
from improvo.files import check_output_folder, make_output_folder, write_json, written_atomically
from improvo.labeling.store import LabelStore, read_records
from labeled_scene import write_labeled_scene

SETTINGS = {"sequence": {"stride": 1}}


def dead_process() -> int:
    """The number of a process that has ended."""
    done = subprocess.Popen([sys.executable, "-c", ""])
    done.wait()
    return done.pid


@pytest.mark.parametrize("name", ["../outside", "/tmp/outside", "..", ".", "", "other", "a/b", "walls\0", 3, None])
def test_a_record_cannot_move_a_folder_out_of_the_store(tmp_path: Path, name: object) -> None:
    store = write_labeled_scene(tmp_path / "labels")
    record = store / "walls" / "label.json"
    record.write_text(json.dumps({**json.loads(record.read_text()), "name": name}))
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "precious.txt").write_text("mine")
    with pytest.raises(InputError, match=r"label\.json: is damaged or of another sequence"):
        LabelStore(store, SETTINGS, relabel=True)
    assert (tmp_path / "outside" / "precious.txt").read_text() == "mine"
    assert record.is_file()


def test_a_record_of_another_state_than_its_file(tmp_path: Path) -> None:
    store = write_labeled_scene(tmp_path / "labels")
    record = json.loads((store / "walls" / "label.json").read_text())
    (store / ".x.failed.json").write_text(json.dumps({**record, "name": "x"}))
    with pytest.raises(InputError, match=r"\.x\.failed\.json"):
        read_records(store)


def test_clearing_a_store_follows_no_link(tmp_path: Path) -> None:
    store = write_labeled_scene(tmp_path / "labels")
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "precious.txt").write_text("mine")
    os.symlink(tmp_path / "outside", store / ".link.partial")
    LabelStore(store, SETTINGS, relabel=True)
    assert (tmp_path / "outside" / "precious.txt").is_file()
    assert not (store / ".link.partial").is_symlink()


def test_writing_follows_no_link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if somebody guessed the temporary name."""
    monkeypatch.setattr(files.secrets, "token_hex", lambda count: "0" * 2 * count)
    (tmp_path / "precious.txt").write_text("mine")
    os.symlink(tmp_path / "precious.txt", tmp_path / files.temporary_name("run.json", ".json"))
    with pytest.raises(OutputError, match="cannot be written"):
        write_json(tmp_path / "run.json", {})
    assert (tmp_path / "precious.txt").read_text() == "mine"


def test_temporary_names_differ_each_time() -> None:
    assert files.temporary_name("a") != files.temporary_name("a")


def test_a_written_file_has_the_usual_permissions(tmp_path: Path) -> None:
    (tmp_path / "plain").write_text("")
    write_json(tmp_path / "ours.json", {})
    assert (tmp_path / "ours.json").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_the_next_run_clears_what_a_killed_one_left(tmp_path: Path) -> None:
    out, dead = tmp_path / "out", dead_process()
    make_output_folder(out, "run")
    (out / "pictures").mkdir()
    left = [out / f".run.json.{dead}-ab12.partial.json", out / f".run.json.{dead}.partial.json"]
    left += [out / "pictures" / f".map.png.{dead}-ab12.partial.png", out / f".tracks.parquet.{dead}-x.partial.parquet"]
    left.append(out / f".x.{os.getpid()}-ab12.partial")  # of an earlier process with the same number, in a container
    for path in left:
        path.write_text("half")
    folder = out / f".cache.{dead}-ab12.partial"
    folder.mkdir()
    (folder / "index.json").write_text("half")
    kept = [out / ".hidden", out / "x.partial", out / f".run.json.{os.getppid()}-ab12.partial.json"]
    for path in kept:
        path.write_text("")
    with written_atomically(out / "busy.txt") as busy:
        make_output_folder(out, "run")
        assert busy.exists()
        busy.write_text("")
    assert not any(path.exists() for path in [*left, folder])
    assert all(path.exists() for path in kept)  # what is not ours, and what a process that still runs is writing


def test_clearing_leftovers_follows_no_link(tmp_path: Path) -> None:
    (tmp_path / "outside").mkdir()
    (tmp_path / "outside" / "precious.txt").write_text("mine")
    make_output_folder(tmp_path / "out", "run")
    os.symlink(tmp_path / "outside", tmp_path / "out" / f".x.{dead_process()}-1.partial")
    make_output_folder(tmp_path / "out", "run")
    assert (tmp_path / "outside" / "precious.txt").is_file()


@pytest.mark.parametrize("content", ["", "[]", "null", '{"made_by": 3}', '{"made_by": ["run"]}', "{" * 9999, "\ud800"])
def test_a_marker_that_somebody_changed(tmp_path: Path, content: str) -> None:
    make_output_folder(tmp_path / "out", "run")
    (tmp_path / "out" / ".improvo.json").write_bytes(content.encode("utf-8", "surrogatepass"))
    with pytest.raises(OutputError, match="has files that improvo did not write"):
        check_output_folder(tmp_path / "out", "run")


def test_the_next_output_file_clears_what_a_killed_command_left_beside_it(tmp_path: Path) -> None:
    """In a folder of the user's, so nothing else there is touched, nor anything below."""
    dead = dead_process()
    left = [tmp_path / f".camera.yaml.{dead}-ab12.partial.yaml", tmp_path / f".camera.json.{dead}-ab12.partial.json"]
    kept = [
        tmp_path / f".camera.yaml.{os.getppid()}-ab12.partial.yaml",  # its process still runs
        tmp_path / ".download.partial",
        tmp_path / ".hidden",
        tmp_path / "below" / f".camera.yaml.{dead}-ab12.partial.yaml",
    ]
    (tmp_path / "below").mkdir()
    for path in [*left, *kept]:
        path.write_text("")
    files.check_output_file(tmp_path / "camera.yaml", (".yaml",))
    assert [path for path in [*left, *kept] if path.exists()] == kept


def test_a_file_that_is_read_is_replaced_only_when_it_is_no_longer(tmp_path: Path) -> None:
    class Reader:
        pass

    path, reader = tmp_path / "walk.mp4", Reader()
    path.write_text("only copy")
    files.never_replace(path, reader)
    os.symlink(path, tmp_path / "link.mp4")
    for target in (path, tmp_path / "link.mp4"):
        with pytest.raises(OutputError, match="is being read, and the output would replace it"):
            files.write_text(target, "")
    files.write_text(tmp_path / "other.mp4", "")
    del reader
    files.write_text(path, "new")
    assert path.read_text() == "new"
