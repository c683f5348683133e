"""Locks where the system's own do not reach: between machines that share a file system."""

from __future__ import annotations

import json
import os
import pickle
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from improvo import files, folder_lock
from improvo.errors import OutputError
from improvo.folder_lock import LOCK, BusyError, claimed, holder_of, locked

ELSEWHERE = {"process": 12, "host": "node7", "since": "2026-01-02 03:04:05", "token": "ab"}


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folder_lock, "_BEAT_SECONDS", 0.05)
    monkeypatch.setattr(folder_lock, "_PATIENCE_SECONDS", 1.0)


@pytest.mark.usefixtures("quick")
def test_a_holder_on_another_machine_is_heard_beating(tmp_path: Path) -> None:
    file = tmp_path / LOCK
    file.write_text(json.dumps(ELSEWHERE))
    stop = threading.Event()

    def beat() -> None:
        while not stop.wait(0.02):
            os.utime(file)

    thread = threading.Thread(target=beat)
    thread.start()
    try:
        words = r"process 12 on node7 \(since 2026-01-02 03:04:05\) is at work there"
        with pytest.raises(BusyError, match=words), locked(tmp_path):
            pass
    finally:
        stop.set()
        thread.join()
    assert json.loads(file.read_text()) == ELSEWHERE


@pytest.mark.usefixtures("quick")
def test_a_holder_on_another_machine_without_a_beat_is_dead(tmp_path: Path) -> None:
    (tmp_path / LOCK).write_text(json.dumps(ELSEWHERE))
    with locked(tmp_path):
        assert json.loads((tmp_path / LOCK).read_text())["process"] == os.getpid()
    assert not (tmp_path / LOCK).exists()


@pytest.mark.usefixtures("quick")
def test_a_lock_beats_while_it_is_held(tmp_path: Path) -> None:
    with locked(tmp_path):
        os.utime(tmp_path / LOCK, (0, 0))
        ends = time.monotonic() + 10
        while (tmp_path / LOCK).stat().st_mtime == 0 and time.monotonic() < ends:
            time.sleep(0.02)
        assert (tmp_path / LOCK).stat().st_mtime > 0


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("content", ["", "process 1 on host", "[1]", "\x00\x00"])
def test_what_an_earlier_version_or_a_full_disk_left_is_no_holder(tmp_path: Path, content: str) -> None:
    (tmp_path / LOCK).write_text(content)
    with locked(tmp_path):
        pass


def test_without_locks_of_the_system_a_running_process_is_still_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(folder_lock, "_lock", lambda descriptor: False)
    monkeypatch.setattr(time, "sleep", lambda seconds: None)
    me = {**ELSEWHERE, "host": folder_lock.socket.gethostname(), "process": os.getppid()}
    (tmp_path / LOCK).write_text(json.dumps(me))
    with pytest.raises(BusyError, match=f"process {os.getppid()} on"), locked(tmp_path):
        pass
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    (tmp_path / LOCK).write_text(json.dumps({**me, "process": dead.pid}))
    with locked(tmp_path):
        pass


def test_claims_of_different_files_do_not_meet(tmp_path: Path) -> None:
    with claimed(tmp_path / "a.lock"), claimed(tmp_path / "b.lock"):
        assert f"process {os.getpid()} on" in holder_of(tmp_path / "a.lock")
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="nowhere"), locked(tmp_path / "nowhere"):
        pass


def test_the_error_crosses_between_processes() -> None:
    error = pickle.loads(pickle.dumps(BusyError(Path("out"), "process 1 on b")))
    assert str(error) == "out: process 1 on b is at work there; wait until it ends, or choose another output folder"
    assert error.holder == "process 1 on b"


def test_temporary_files_of_another_machine_stay_for_a_day(tmp_path: Path) -> None:
    mine = tmp_path / files.temporary_name("a")
    theirs = tmp_path / mine.name.replace(f"-{files._HOST}", "-0f0f0f").replace(f".{os.getpid()}-", ".1-")
    mine.touch()
    theirs.touch()
    files.clear_leftovers(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [theirs.name]
    os.utime(theirs, (0, 0))
    files.clear_leftovers(tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """No locks of the system, none of its calls that Windows lacks, and no open file is removed."""
    closed: list[int] = []
    close, unlink = os.close, os.unlink

    def close_noted(descriptor: int) -> None:
        close(descriptor)
        closed.append(descriptor)

    def unlink_closed(path: Path) -> None:
        if not closed:
            raise PermissionError(13, "The process cannot access the file because it is being used")
        unlink(path)

    for name in ("pread", "pwrite"):
        monkeypatch.delattr(os, name, raising=False)
    monkeypatch.setattr(os, "close", close_noted)
    monkeypatch.setattr(os, "unlink", unlink_closed)
    monkeypatch.setattr(folder_lock, "_WINDOWS", True)
    monkeypatch.setattr(folder_lock, "_lock", lambda descriptor: False)
    monkeypatch.setattr(folder_lock, "process_exists", lambda process: True)  # it cannot be told


@pytest.mark.usefixtures("quick", "windows")
def test_a_folder_is_locked_and_let_go_on_windows(tmp_path: Path) -> None:
    with locked(tmp_path):
        assert json.loads((tmp_path / LOCK).read_text())["process"] == os.getpid()
    assert not (tmp_path / LOCK).exists()


@pytest.mark.usefixtures("quick", "windows")
def test_what_a_killed_process_left_on_windows_holds_no_folder_for_ever(tmp_path: Path) -> None:
    (tmp_path / LOCK).write_text(json.dumps({**ELSEWHERE, "host": socket.gethostname()}))
    with locked(tmp_path):
        assert json.loads((tmp_path / LOCK).read_text())["process"] == os.getpid()
