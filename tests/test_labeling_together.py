"""Several commands that fill one label store together, and commands that must not share a folder."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rendered_walk import write_walk

from improvo.cli.main import main
from improvo.errors import OutputError
from improvo.folder_lock import claimed, locked
from improvo.labeling import label_job
from improvo.labeling import label_sequences as module
from improvo.labeling.label_sequences import label_sequences
from improvo.labeling.store import DONE, LabelStore, SequenceRecord, lock_of, read_records
from improvo.odometry.run_settings import LabelRunSettings

OPTIONS = ["--frontend", "orb", "--max-keypoints", "200", "--set", "labels.min_observations=6"]
OPTIONS += ["--set", "labels.quality.enabled=false"]
SETTINGS = {"frontend": {"name": "orb"}}

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no fcntl")

HOLD = """
import sys
from pathlib import Path
from improvo.folder_lock import claimed
with claimed(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.readline()
"""


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("walks")
    return [write_walk(folder / name, frames=16, seed=seed) for seed, name in enumerate(("attic", "hall", "kitchen"))]


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}


def hold(file: Path) -> subprocess.Popen[str]:
    """A process that holds a lock until a line comes."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(file)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment(),
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def tables(store: Path) -> dict[str, bytes]:
    return {f"{p.parent.name}/{p.name}": p.read_bytes() for p in store.glob("*/*.parquet")}


def test_two_commands_share_the_work(walks: list[Path], tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    alone, together = tmp_path / "alone", tmp_path / "together"
    words = [*map(str, walks), *OPTIONS]
    assert main(["label", *words, "-o", str(alone)]) == 0
    other = subprocess.Popen([sys.executable, "-m", "improvo", "label", *words, "-o", str(together)], env=environment())
    while not list(together.glob(".*.lock")) and other.poll() is None:
        time.sleep(0.01)
    assert main(["label", *words, "-o", str(together)]) == 0
    assert other.wait(timeout=120) == 0
    assert tables(together) == tables(alone)
    assert not [path.name for path in together.iterdir() if path.name.endswith((".lock", ".partial"))]


def test_a_sequence_that_another_process_labels_is_waited_for(
    walks: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_POLL_SECONDS", 0.01)
    done: list[str] = []

    def label(job: label_job.LabelJob, tick: object) -> SequenceRecord:
        done.append(job.name)
        return SequenceRecord(job.name, str(job.path), DONE, stable=1)

    def labelled(job: label_job.LabelJob, tick: object) -> SequenceRecord:
        job.folder.mkdir()
        return label(job, tick)

    monkeypatch.setattr(label_job, "_labeled", labelled)
    store = tmp_path / "labels"
    LabelStore(store, module.fingerprint(LabelRunSettings(), False), kind=LabelRunSettings)
    holder = hold(lock_of(store, "attic"))
    waited: list[tuple[str, str]] = []

    def on_wait(name: str, who: str) -> None:
        waited.append((name, who))
        assert holder.stdin is not None
        holder.stdin.close()

    records = label_sequences(walks, store, LabelRunSettings(), on_wait=on_wait)
    holder.wait()
    assert [record.state for record in records] == [DONE] * 3
    assert done == ["hall", "kitchen", "attic"]
    assert waited[0][0] == "attic"
    assert f"process {holder.pid} on" in waited[0][1]
    assert [record.name for record in read_records(store)] == ["attic", "hall", "kitchen"]


def test_a_second_command_leaves_alone_what_the_first_works_on(tmp_path: Path) -> None:
    store = LabelStore(tmp_path / "labels", SETTINGS)
    for name in ("busy", "killed"):
        store.partial(name).mkdir()
        (store.folder / f".{name}.partial" / "tracks.parquet").touch()
    holder = hold(lock_of(store.folder, "busy"))
    try:
        LabelStore(store.folder, SETTINGS)
        assert [path.name for path in store.folder.glob(".*.partial")] == [".busy.partial"]
        with pytest.raises(OutputError, match=f"process {holder.pid} on .* is at work there"):
            LabelStore(store.folder, {**SETTINGS, "seed": 1}, relabel=True)
    finally:
        holder.kill()
        holder.wait()
    LabelStore(store.folder, {**SETTINGS, "seed": 1}, relabel=True)
    assert not list(store.folder.glob(".*.partial"))


def test_a_second_run_on_a_folder_says_who_is_there(
    walks: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    command = ["run", str(walks[0]), "-o", str(out), "--frontend", "orb"]
    assert main(command) == 0
    before = (out / "run.json").read_bytes()
    holder = hold(out / ".improvo.lock")
    try:
        capsys.readouterr()
        assert main(command) == 2
        said = capsys.readouterr().err
    finally:
        holder.kill()
        holder.wait()
    assert f"{out}: process {holder.pid} on" in said
    assert "is at work there" in said
    assert (out / "run.json").read_bytes() == before
    assert main(command) == 0


def test_nested_claims_of_a_store_and_its_sequences(tmp_path: Path) -> None:
    with locked(tmp_path), claimed(lock_of(tmp_path, "a")):
        assert {path.name for path in tmp_path.iterdir()} == {".improvo.lock", ".a.lock"}
