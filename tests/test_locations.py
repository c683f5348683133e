"""Label stores and outputs at a location: in memory, and on an S3 server on this machine where one is installed."""

from __future__ import annotations

import importlib.util
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rendered_walk import write_walk

from improvement_example import SETTINGS
from improvo import locations
from improvo.cli.main import main
from improvo.errors import InputError, OutputError
from improvo.files import write_text
from improvo.frontend.settings import FrontendSettings
from improvo.labeling.label_sequences import LabelJob, label_sequence
from improvo.labeling.labeled import read_labels
from improvo.locations import fetched, is_remote, local_folder, place, publish, with_urls
from improvo.odometry.run_settings import LabelRunSettings
from improvo.stability.settings import LabelQualitySettings, LabelSettings
from labeled_scene import write_labeled_scene

fsspec = pytest.importorskip("fsspec", reason="locations need the extra `remote`")

ORB = ["--frontend", "orb", "--max-keypoints", "200", "--set", "labels.min_observations=6"]
ORB += ["--set", "labels.quality.enabled=false", "--pack"]
BUCKET = "improvo-test"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder for what stands for locations, and no waiting between tries."""
    monkeypatch.setenv("IMPROVO_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(place, "_WAITS", (0.0, 0.0))
    locations._places.clear()
    yield tmp_path / "cache"
    locations._places.clear()


@pytest.fixture
def memory() -> Iterator[str]:
    """A location in memory, empty."""
    system = fsspec.filesystem("memory")
    system.store.clear()
    yield "memory://bucket/work"
    system.store.clear()


@pytest.fixture(scope="module")
def s3() -> Iterator[str]:
    """A location on an S3 server of our own."""
    for name in ("moto", "s3fs", "flask"):
        if importlib.util.find_spec(name) is None:
            pytest.skip(f"needs an S3 server: pip install 'moto[server]' s3fs ({name} is missing)")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = subprocess.Popen(
        [sys.executable, "-m", "moto.server", "-p", str(port)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    keys = {"AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b", "AWS_DEFAULT_REGION": "us-east-1"}
    keys["AWS_ENDPOINT_URL"] = keys["AWS_ENDPOINT_URL_S3"] = f"http://127.0.0.1:{port}"
    before = {name: os.environ.get(name) for name in keys}
    os.environ.update(keys)
    try:
        ends = time.monotonic() + 120
        while time.monotonic() < ends:
            try:
                socket.create_connection(("127.0.0.1", port), 1).close()
                break
            except OSError:
                time.sleep(0.1)
        fsspec.filesystem("s3").mkdir(BUCKET)
        yield f"s3://{BUCKET}/work"
    finally:
        server.terminate()
        server.wait()
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


def names(url: str) -> set[str]:
    """Of the files at a location."""
    system, root = fsspec.core.url_to_fs(url)
    system.invalidate_cache()
    return {name.removeprefix(root).lstrip("/") for name in system.find(root)}


def upload(folder: Path, url: str) -> None:
    system, root = fsspec.core.url_to_fs(url)
    for path in folder.rglob("*"):
        if path.is_file():
            system.pipe_file(f"{root}/{path.relative_to(folder).as_posix()}", path.read_bytes())


def forget(cache: Path) -> None:
    """As on another machine."""
    import shutil

    locations._places.clear()
    shutil.rmtree(cache)


def test_paths_of_this_machine_stay_what_they_are(tmp_path: Path) -> None:
    assert local_folder("out/labels") == Path("out/labels")
    assert local_folder(f"file://{tmp_path}/labels") == tmp_path / "labels"
    assert not is_remote("C:/video")
    assert is_remote("s3://bucket/labels")
    assert with_urls(str(tmp_path)) == str(tmp_path)


def test_what_is_complete_is_sent_and_comes_back_elsewhere(memory: str, cache: Path) -> None:
    folder = local_folder(memory)
    write_text(folder / "deep" / "a.txt", "one")
    assert names(memory) == {"deep/a.txt"}
    (folder / "metrics.jsonl").write_text("{}")  # written otherwise
    (folder / ".improvo.lock").write_text("mine")
    (folder / ".x.partial").mkdir()
    write_text(folder / ".x.partial" / "half.txt", "half")
    publish(folder)
    assert names(memory) == {"deep/a.txt", "metrics.jsonl"}
    forget(cache)
    again = local_folder(memory)
    assert (again / "deep" / "a.txt").read_text() == "one"
    (again / "deep" / "a.txt").write_text("two, longer")  # changed here, not yet sent
    locations._places.clear()
    assert (local_folder(memory) / "deep" / "a.txt").read_text() == "two, longer"
    publish(again)
    assert fsspec.filesystem("memory").cat_file("/bucket/work/deep/a.txt") == b"two, longer"
    fsspec.filesystem("memory").pipe_file("/bucket/work/deep/a.txt", b"three, there")  # changed there
    assert (local_folder(memory) / "deep" / "a.txt").read_text() == "three, there"


def check_labels(url: str, tmp_path: Path, cache: Path) -> None:
    """Labels at a location are those of a local store, and training reads what it draws."""
    walks = [str(write_walk(tmp_path / name, frames=16, seed=seed)) for seed, name in enumerate(("attic", "hall"))]
    assert main(["label", walks[0], *ORB, "-o", f"{url}/labels"]) == 0
    assert main(["label", *walks, *ORB, "-o", str(tmp_path / "local")]) == 0
    forget(cache)
    assert main(["label", *walks, *ORB, "-o", f"{url}/labels"]) == 0  # goes on
    left = {path.name for path in cache.rglob("*") if path.is_file() and path.parent.name in ("attic", "hall")}
    assert left == {"label.json"}
    found, expected = (
        read_labels(local_folder(f"{url}/labels", writing=False)),
        read_labels(tmp_path / "local"),
    )
    assert [sequence.name for sequence in found] == ["attic", "hall"]
    for one, other in zip(found, expected, strict=True):
        assert (one.tracks.keypoints == other.tracks.keypoints).all()
        assert (one.points.stability == other.points.stability).all()
        assert (one.image(3) == other.image(3)).all()
        assert one.cam_from_world.shape == other.cam_from_world.shape
    assert not list(cache.rglob("images-*"))  # only a part of it was read


def test_labels_in_memory(memory: str, tmp_path: Path, cache: Path) -> None:
    check_labels(memory, tmp_path, cache)


def test_labels_on_s3(s3: str, tmp_path: Path, cache: Path) -> None:
    check_labels(s3, tmp_path, cache)


def check_training(url: str, tmp_path: Path, cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A training that was stopped goes on elsewhere, and ends with the weights of one that was not."""
    pytest.importorskip("torch", reason="training needs the extra `train`")
    store = write_labeled_scene(tmp_path / "labels")
    upload(store, f"{url}/labels")
    words = ["train", "odometry", f"{url}/labels", "--from", "superpoint-small", "--batch-size", "2"]
    words += ["--workers", "0", "--threads", "1"]
    words += ["--set", "views.height=48", "--set", "views.width=64", "--set", "optimiser.decay_steps=1"]
    assert main([*words, "--steps", "2", "-o", f"{url}/network"]) == 0
    assert f"{url}/network/weights.safetensors" in capsys.readouterr().out
    assert {"weights.safetensors", "weights.json", "metrics.jsonl", "checkpoint.pt"} <= names(f"{url}/network")
    assert not any("landmarks" in name for name in names(f"{url}/labels"))
    forget(cache)
    assert main([*words, "--steps", "4", "-o", f"{url}/network"]) == 0
    assert main([*words, "--steps", "2", "-o", str(tmp_path / "local")]) == 0
    assert main([*words, "--steps", "4", "-o", str(tmp_path / "local")]) == 0
    system, root = fsspec.core.url_to_fs(f"{url}/network")
    trained = system.cat_file(f"{root}/metrics.jsonl").decode().splitlines()
    assert [line.split(",")[0] for line in trained] == ['{"step": 2', '{"step": 4']
    assert len((tmp_path / "local" / "metrics.jsonl").read_text().splitlines()) == len(trained)


def test_training_in_memory(memory: str, tmp_path: Path, cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    check_training(memory, tmp_path, cache, capsys)


def test_training_on_s3(s3: str, tmp_path: Path, cache: Path, capsys: pytest.CaptureFixture[str]) -> None:
    check_training(s3, tmp_path, cache, capsys)


def test_a_loop_goes_on_elsewhere(memory: str, tmp_path: Path, cache: Path) -> None:
    pytest.importorskip("torch", reason="training needs the extra `train`")
    from improvement_example import FakeTraining
    from improvement_example import run as improve

    walk = write_walk(tmp_path / "room", frames=30, seed=3)
    settings = replace(SETTINGS, frontend=replace(SETTINGS.frontend, name="superpoint-small"))
    first, second = FakeTraining(), FakeTraining()
    improve(local_folder(f"{memory}/better"), [walk], first, rounds=1, settings=settings)
    publish(local_folder(f"{memory}/better"))
    weights = fsspec.filesystem("memory").cat_file("/bucket/work/better/weights.safetensors")
    forget(cache)
    result = improve(local_folder(f"{memory}/better"), [walk], second, rounds=1, settings=settings)
    assert (len(first.calls), len(second.calls)) == (1, 0)
    assert result.weights.read_bytes() == weights


def test_a_worker_on_another_machine_labels_into_the_location(memory: str, tmp_path: Path, cache: Path) -> None:
    walk = write_walk(tmp_path / "attic", frames=16, seed=0)
    elsewhere = tmp_path / "no" / "such" / "folder"
    network = FrontendSettings(name="orb", max_keypoints=200)
    settings = LabelRunSettings(
        frontend=network, labels=LabelSettings(min_observations=6, quality=LabelQualitySettings(enabled=False))
    )
    record = label_sequence(LabelJob("attic", walk, elsewhere, settings, False, memory), lambda: None)
    assert record.tracked > 10
    assert {"attic/label.json", "attic/tracks.parquet"} <= names(memory)
    assert not elsewhere.exists()


class Failing:
    """A file system that fails some times."""

    def __init__(self, real: Any, method: str, times: int, fault: Exception) -> None:
        self._real, self._method, self.left, self._fault = real, method, times, fault

    def __getattr__(self, name: str) -> Any:
        if name != self._method:
            return getattr(self._real, name)

        def fail(*given: Any, **named: Any) -> Any:
            if self.left:
                self.left -= 1
                raise self._fault
            return getattr(self._real, name)(*given, **named)

        return fail


def test_a_fault_that_passes_is_tried_again(memory: str) -> None:
    folder = local_folder(memory)
    opened = locations._places[folder]
    opened._fs = Failing(opened.fs, "put_file", 2, TimeoutError("slow"))
    write_text(folder / "a.txt", "one")
    assert names(memory) == {"a.txt"}
    assert opened._fs.left == 0


def test_a_full_bucket_is_one_line_and_a_second_start_goes_on(memory: str) -> None:
    folder = local_folder(memory)
    opened = locations._places[folder]
    opened._fs = Failing(opened.fs, "put_file", 1000, OSError("QuotaExceeded:\n no room"))
    words = rf"{memory}: cannot be written \(QuotaExceeded: no room\); what is done is kept in .*; run again to go on"
    with pytest.raises(OutputError, match=words):
        write_text(folder / "a.txt", "one")
    assert opened._fs.left == 997
    locations._places.clear()
    again = local_folder(memory)
    assert (again / "a.txt").read_text() == "one"
    publish(again)
    assert names(memory) == {"a.txt"}


def test_a_store_that_vanishes_is_one_line(memory: str, tmp_path: Path) -> None:
    upload(write_labeled_scene(tmp_path / "labels"), memory)
    folder = local_folder(memory, writing=False)
    (sequence,) = read_labels(folder)
    fsspec.filesystem("memory").store.clear()
    with pytest.raises(InputError, match=f"{memory}: cannot be read"):
        _ = sequence.tracks
    assert not fetched(folder / "nothing").exists()


def test_unknown_schemes_are_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["label", str(tmp_path), "-o", "nowhere9://bucket/labels"]) == 2
    said = capsys.readouterr().err
    assert "nowhere9://bucket/labels: cannot be reached" in said
    assert said.count("\n") == 1


def test_relabelling_clears_the_location(memory: str, tmp_path: Path, cache: Path) -> None:
    walk = str(write_walk(tmp_path / "attic", frames=16, seed=0))
    words = ["label", walk, "-o", memory, *ORB]
    assert main(words) == 0
    assert "attic/label.json" in names(memory)
    assert main([*words, "--set", "labels.min_observations=7"]) == 2
    forget(cache)
    (tmp_path / "attic" / "camera.yaml").write_text("damaged")
    assert main([*words, "--set", "labels.min_observations=7", "--relabel"]) == 2
    assert not any(name.startswith("attic/") for name in names(memory))
