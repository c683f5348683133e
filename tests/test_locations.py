"""Label stores at a location, faults of the location, and what is where."""

from __future__ import annotations

import json
import os
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from rendered_walk import write_walk

from improvo import locations
from improvo.cli.main import main
from improvo.errors import InputError, OutputError
from improvo.files import write_text
from improvo.folder_lock import locked, seems_held
from improvo.frontend.settings import FrontendSettings
from improvo.labeling import label_sequences as label_module
from improvo.labeling.label_job import LabelJob, label_sequence
from improvo.labeling.labeled import read_labels
from improvo.locations import claim, fetched, local_folder, place, publish, with_urls
from improvo.odometry.run_settings import LabelRunSettings
from improvo.stability.settings import LabelQualitySettings, LabelSettings
from labeled_scene import write_labeled_scene
from location_places import cache, forget, fsspec, memory, names, s3, upload

__all__ = ["cache", "memory", "s3"]  # fixtures

ORB = ["--frontend", "orb", "--max-keypoints", "200", "--set", "labels.min_observations=6"]
ORB += ["--set", "labels.quality.enabled=false", "--pack"]


def test_paths_of_this_machine_stay_what_they_are(tmp_path: Path) -> None:
    assert local_folder("out/labels") == Path("out/labels")
    assert local_folder(f"file://{tmp_path}/labels") == tmp_path / "labels"
    assert local_folder("C:/video") == Path("C:/video")
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


def check_same_size(url: str, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Networks of one architecture all have one size: the one of now is that which was written last, by whomever."""
    for machine, seen, step in (("one", "", "200"), ("other", "200", "500"), ("one", "500", "900"), ("one", "900", "")):
        locations._places.clear()
        monkeypatch.setenv("IMPROVO_CACHE", str(cache / machine))
        weights = local_folder(url) / "weights.safetensors"
        assert (weights.read_text() if weights.exists() else "") == seen
        if step:
            write_text(weights, step)


def test_a_file_of_the_same_size_is_fetched_anew(memory: str, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check_same_size(memory, cache, monkeypatch)


def test_a_file_of_the_same_size_is_fetched_anew_from_s3(s3: str, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check_same_size(f"{s3}/network", cache, monkeypatch)


def test_what_is_known_of_a_location_by_an_earlier_version_stays_valid(memory: str, cache: Path) -> None:
    write_text(local_folder(memory) / "a.txt", "one")
    (state,) = cache.rglob(place.STATE)
    known = json.loads(state.read_text())
    known["sent"] = {name: entry[:2] for name, entry in known["sent"].items()}
    state.write_text(json.dumps(known))
    locations._places.clear()
    before = (local_folder(memory) / "a.txt").stat()
    assert (local_folder(memory) / "a.txt").stat() == before
    state.write_text("{}")  # damaged
    locations._places.clear()
    assert (local_folder(memory) / "a.txt").read_text() == "one"


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


def test_labelling_ends_where_the_store_vanishes_and_goes_on_later(
    memory: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    walks = [str(write_walk(tmp_path / name, frames=16, seed=0)) for name in ("attic", "hall", "kitchen")]
    words = ["label", *walks, "-o", memory, *ORB]
    tries: list[str] = []
    file_system = locations.Place.fs.fget
    assert file_system is not None

    def gone(self: locations.Place) -> Any:
        real = file_system(self)
        if not any(name.endswith("attic/label.json") for name in real.find("bucket")):
            return real
        return Failing(real, "info", 1000, TimeoutError("no answer"))

    with monkeypatch.context() as away:
        away.setattr(locations.Place, "fs", property(gone))
        away.setattr(time, "sleep", lambda seconds: tries.append("again"))
        assert main(words) == 2
    said = capsys.readouterr()
    assert said.out.count("frames with a pose") == 1
    assert f"{memory}: cannot be read (no answer); try again" in said.err
    assert len(tries) == 2
    assert main(words) == 0
    assert "3 of 3 sequences labelled" in capsys.readouterr().out


def test_where_it_does_not_answer_one_try_is_enough_to_see_whether_it_is_back(memory: str) -> None:
    folder = local_folder(memory)
    opened = locations._places[folder]
    opened._fs = Failing(opened.fs, "put_file", 4, TimeoutError("slow"))
    for left in (1, 0):
        with pytest.raises(OutputError, match="cannot be written"):
            write_text(folder / "a.txt", "one")
        assert opened._fs.left == left
    write_text(folder / "b.txt", "two")
    publish(folder)
    assert names(memory) == {"a.txt", "b.txt"}


def test_a_location_that_lost_all_of_it_is_begun_anew(memory: str, tmp_path: Path) -> None:
    words = ["label", str(write_walk(tmp_path / "attic", frames=16, seed=0)), "-o", memory, *ORB]
    assert main(words) == 0
    there = names(memory)
    fsspec.filesystem("memory").store.clear()
    locations._places.clear()
    assert main(words) == 0
    assert names(memory) == there


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


def other_machine(url: str, tmp_path: Path) -> locations.Place:
    """The location as another machine sees it."""
    folder = tmp_path / "elsewhere" / "files"
    folder.mkdir(parents=True)
    return locations.Place(url, folder, True)


@pytest.fixture
def quick_claims(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(claim, "BEAT_SECONDS", 0.2)
    monkeypatch.setattr(claim, "_LOOK_SECONDS", 0.05)
    monkeypatch.setattr(claim, "_SETTLE_SECONDS", 0.0)


def check_lock(url: str, tmp_path: Path) -> None:
    """The second one is told who is there; after the first has ended, or died, it is free."""
    there = other_machine(url, tmp_path)
    mine = {"process": 7, "host": "far-away", "since": "2026-11-28 03:00:00", "token": "a"}
    held = claim.Claim(there, there.folder / ".improvo.lock", mine, lambda holder: False)
    here = local_folder(url)
    with pytest.raises(OutputError, match=r"process 7 on far-away \(since .*\) is at work there"), locked(here):
        pass
    assert seems_held(here / ".improvo.lock")
    held.release()
    with locked(here):
        assert names(url) == {".improvo.lock"}
    assert names(url) == set()
    died = claim.Claim(there, there.folder / ".improvo.lock", mine, lambda holder: False)
    died._released.set()  # without a beat
    time.sleep(0.5)
    with locked(here):
        found = claim.read_claim(there, there.folder / ".improvo.lock")
        assert found is not None
        assert found["process"] == os.getpid()
        died.release()  # is not its own any more
    assert names(url) == set()


def test_who_was_taken_for_dead_does_not_take_it_back(memory: str, tmp_path: Path, quick_claims: None) -> None:
    """A laptop that slept wakes up, and somebody else is at work."""
    there = other_machine(memory, tmp_path)
    path = there.folder / ".improvo.lock"
    slept = claim.Claim(there, path, {"token": "a"}, lambda holder: False)
    works = claim.Claim(there, path, {"token": "b"}, lambda holder: True)
    seen = set()
    for _ in range(40):
        time.sleep(0.02)
        seen.add((claim.read_claim(there, path) or {}).get("token"))
    assert seen == {"b"}
    slept.release()
    assert names(memory) == {".improvo.lock"}
    works.release()
    assert names(memory) == set()


def test_a_beat_on_its_way_does_not_outlast_the_claim(
    memory: str, tmp_path: Path, quick_claims: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = other_machine(memory, tmp_path)
    held = claim.Claim(there, there.folder / ".improvo.lock", {"token": "a"}, lambda holder: False)
    begun, write = threading.Event(), held._write

    def slowly() -> None:
        begun.set()
        time.sleep(0.3)
        write()

    monkeypatch.setattr(held, "_write", slowly)
    assert begun.wait(10)
    held.release()
    time.sleep(0.4)
    assert names(memory) == set()


def test_a_lock_at_a_location_in_memory(memory: str, tmp_path: Path, quick_claims: None) -> None:
    check_lock(memory, tmp_path)


def test_a_lock_at_a_location_on_s3(s3: str, tmp_path: Path, quick_claims: None) -> None:
    check_lock(f"{s3}/locks", tmp_path)


def test_of_two_that_begin_at_once_the_last_to_write_has_it(
    memory: str, tmp_path: Path, quick_claims: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where a file cannot be created only if it is not there."""
    there = other_machine(memory, tmp_path)
    path = there.folder / ".improvo.lock"
    monkeypatch.setattr(claim.Claim, "_created", lambda self: False)

    def other_writes(seconds: float) -> None:
        there.fs.pipe_file(there.remote(path), b'{"process": 8, "host": "far-away", "token": "b"}')

    monkeypatch.setattr(claim.time, "sleep", other_writes)
    with pytest.raises(claim.ClaimedError, match="far-away"):
        claim.Claim(there, path, {"token": "a"}, lambda holder: False)


def test_a_sequence_that_another_machine_labels_is_waited_for_and_taken(
    memory: str, tmp_path: Path, quick_claims: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    walks = [write_walk(tmp_path / name, frames=16, seed=seed) for seed, name in enumerate(("attic", "hall"))]
    network = FrontendSettings(name="orb", max_keypoints=200)
    settings = LabelRunSettings(
        frontend=network, labels=LabelSettings(min_observations=6, quality=LabelQualitySettings(enabled=False))
    )
    monkeypatch.setattr(label_module, "_POLL_SECONDS", 0.05)
    (expected,) = label_module.label_sequences(walks[:1], tmp_path / "local", settings)
    there = other_machine(memory, tmp_path)
    mine = {"process": 7, "host": "far-away", "token": "a"}
    held = claim.Claim(there, there.folder / ".attic.lock", mine, lambda holder: False)
    waited: list[tuple[str, str]] = []

    def on_wait(name: str, holder: str) -> None:
        if not waited:
            upload(tmp_path / "local" / "attic", f"{memory}/attic")
            held.release()
        waited.append((name, holder))

    records = label_module.label_sequences(walks, local_folder(memory), settings, on_wait=on_wait)
    assert waited == [("attic", "process 7 on far-away")]
    assert [record.name for record in records] == ["attic", "hall"]
    assert records[0].seconds == expected.seconds  # it was not labelled once more
