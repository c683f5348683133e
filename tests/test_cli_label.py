"""`improvo label` as a user meets it: resumable, the same for any number of workers, one failure spoils no other."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from rendered_walk import write_walk

from improvo.cli.main import main
from improvo.labeling.labeled import read_labels
from improvo.stability.rule import STABLE
from improvo.stability.tables import read_points

OPTIONS = ["--frontend", "orb", "--max-keypoints", "300", "--set", "labels.min_observations=6"]


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two recordings, and one of black frames."""
    folder = tmp_path_factory.mktemp("walks")
    good = [write_walk(folder / name, frames=22, seed=seed) for seed, name in enumerate(("kitchen", "hall"))]
    black = folder / "black"
    black.mkdir()
    for i in range(12):
        cv2.imwrite(str(black / f"{i:06d}.png"), np.zeros((240, 320), np.uint8))
    (black / "camera.yaml").write_text((good[0] / "camera.yaml").read_text())
    return [*good, black]


@pytest.fixture(scope="module")
def labelled(walks: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The store of one run over all of them."""
    out = tmp_path_factory.mktemp("store") / "labels"
    assert main(["label", *map(str, walks), "-o", str(out), *OPTIONS]) == 0
    return out


def contents(store: Path) -> dict[str, bytes]:
    """All label tables, byte for byte."""
    names = ("tracks.parquet", "points.parquet", "frames.parquet", "trajectory.txt")
    return {str(p.relative_to(store)): p.read_bytes() for p in sorted(store.rglob("*")) if p.name in names}


def test_good_sequences_are_labelled_and_the_bad_one_is_explained(labelled: Path) -> None:
    rows = {row["name"]: row for row in pq.read_table(labelled / "manifest.parquet").to_pylist()}
    assert {name: row["state"] for name, row in rows.items()} == {"kitchen": "done", "hall": "done", "black": "failed"}
    assert rows["kitchen"]["stable"] > 20
    assert "black" in rows["black"]["reason"]
    assert not (labelled / "black").exists()


def test_the_store_reads_back(labelled: Path, walks: list[Path]) -> None:
    sequences = read_labels(labelled)
    assert [sequence.name for sequence in sequences] == ["hall", "kitchen"]
    kitchen = sequences[1]
    assert (kitchen.points.stability == STABLE).sum() == kitchen.record.stable
    assert set(kitchen.tracks.track) == set(kitchen.points.track)
    assert kitchen.frames.source_index.tolist() == list(range(22))
    picture = cv2.imread(str(walks[0] / "000007.png"), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(kitchen.image(7), picture)


def test_a_second_run_does_nothing_and_says_so(
    labelled: Path, walks: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.stat().st_mtime_ns for path in labelled.rglob("*.parquet") if path.parent != labelled}
    capsys.readouterr()
    assert main(["label", *map(str, walks[:2]), "-o", str(labelled), *OPTIONS]) == 0
    assert "2 of 2 sequences labelled" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_other_settings_are_refused_in_one_line(
    labelled: Path, walks: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert main(["label", str(walks[0]), "-o", str(labelled), "--frontend", "orb", "--max-keypoints", "301"]) == 2
    message = capsys.readouterr().err.strip()
    assert message.startswith("improvo: ")
    assert "--relabel" in message
    assert "\n" not in message


def test_nothing_to_label_is_an_error(walks: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["label", str(walks[2]), "-o", str(tmp_path / "labels"), *OPTIONS]) == 2
    assert "nothing could be labelled; black: " in capsys.readouterr().err


def test_workers_give_the_same_bytes(labelled: Path, walks: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "labels"
    assert main(["label", *map(str, walks), "-o", str(out), "--workers", "2", *OPTIONS]) == 0
    assert contents(out) == contents(labelled)


def test_run_and_label_give_the_same_labels(labelled: Path, walks: list[Path], tmp_path: Path) -> None:
    for walk in walks[:2]:
        out = tmp_path / walk.name
        assert main(["run", str(walk), "-o", str(out), *OPTIONS]) == 0
        for name in ("tracks.parquet", "points.parquet"):
            assert (out / name).read_bytes() == (labelled / walk.name / name).read_bytes()
        report = json.loads((out / "run.json").read_text())
        assert report["tracks"] == json.loads((labelled / walk.name / "run.json").read_text())["tracks"]
        assert report["tracks"]["stable"] > 20
        assert set(report["quality"]) >= {"no_pose", "high_error", "little_parallax", "contradicted", "not_trusted"}


def test_a_run_withholds_labels_where_its_settings_say_so(walks: list[Path], tmp_path: Path) -> None:
    strict = ["--set", "labels.quality.min_median_parallax_deg=90"]
    for name, options in (("withheld", strict), ("raw", [*strict, "--set", "labels.second_opinion.enabled=false"])):
        assert main(["run", str(walks[0]), "-o", str(tmp_path / name), *OPTIONS, *options]) == 0
    withheld, raw = (read_points(tmp_path / name / "points.parquet") for name in ("withheld", "raw"))
    assert raw.counts()["withheld"] == 0 < raw.counts()["stable"]
    assert withheld.counts() == {
        "ignore": len(raw),
        "unstable": 0,
        "stable": 0,
        "withheld": raw.counts()["stable"] + raw.counts()["unstable"],
    }


def test_a_store_of_a_former_version_goes_on(
    labelled: Path, walks: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = shutil.copytree(labelled, tmp_path / "labels")
    settings = yaml.safe_load((out / "settings.yaml").read_text())
    settings["labels"]["second_opinion"] = settings["labels"].pop("quality")
    settings["odometry"]["initialisation"] = settings["odometry"].pop("mode")
    del settings["labels"]["loss_width"]  # as if it had come later
    (out / "settings.yaml").write_text(yaml.safe_dump(settings))
    before = contents(out)
    assert main(["label", str(walks[0]), "-o", str(out), *OPTIONS]) == 0
    assert contents(out) == before
    assert read_labels(out)[0].rule.quality.enabled
    settings["labels"]["stable_mean_error"] = 0.9
    (out / "settings.yaml").write_text(yaml.safe_dump(settings))
    capsys.readouterr()
    assert main(["label", str(walks[0]), "-o", str(out), *OPTIONS]) == 2
    assert "labels.stable_mean_error=0.9, now 1.0" in capsys.readouterr().err


def test_packed_frames_need_no_recording(walks: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "labels"
    assert main(["label", str(walks[0]), "-o", str(out), "--pack", *OPTIONS]) == 0
    (sequence,) = read_labels(out)
    moved = sequence.folder.rename(tmp_path / "elsewhere")
    assert len(list(moved.glob("images-*.parquet"))) == 1
    packed = replace(sequence, folder=moved).image(5)
    picture = cv2.imread(str(walks[0] / "000005.png"), cv2.IMREAD_GRAYSCALE)
    assert np.abs(packed.astype(int) - picture).mean() < 3


@pytest.mark.skipif(os.name == "nt", reason="needs POSIX signals")
@pytest.mark.parametrize("workers", ["1", "2"])
def test_termination_ends_the_command_and_the_next_one_goes_on(
    labelled: Path, walks: list[Path], tmp_path: Path, workers: str
) -> None:
    out = tmp_path / "labels"
    command = [sys.executable, "-m", "improvo", "label", *map(str, walks), "-o", str(out), "--workers", workers]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen([*command, *OPTIONS], env=environment, stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + 60
        while not list(out.glob(".*.partial/.tracks*")) and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)
        process.terminate()
        _, said = process.communicate(timeout=60)
        assert process.returncode == 130
    assert "improvo: interrupted" in said
    assert "Traceback" not in said
    assert main([*command[3:], *OPTIONS]) == 0
    assert contents(out) == contents(labelled)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
def test_a_killed_run_resumes_to_the_same_labels(labelled: Path, walks: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "labels"
    command = [sys.executable, "-m", "improvo", "label", *map(str, walks[:2]), "-o", str(out), *OPTIONS]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while not list(out.glob(".*.partial/.tracks*")) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    process.kill()
    process.wait()
    assert list(out.glob(".*.partial"))
    assert not list(out.glob("*/label.json"))
    assert main(command[3:]) == 0
    assert contents(out) == contents(labelled)
    assert not list(out.glob(".*.partial"))


def test_labels_of_what_was_there_before_are_refused(
    walks: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same path holds another recording by now."""
    place, out = tmp_path / "take", tmp_path / "labels"
    shutil.copytree(walks[0], place)
    command = ["label", str(place), "-o", str(out), *OPTIONS]
    assert main(command) == 0
    assert main(command) == 0
    shutil.rmtree(place)
    shutil.copytree(walks[1], place)
    before = (out / "take" / "points.parquet").read_bytes()
    capsys.readouterr()
    assert main(command) == 2
    assert f"{place}: is not what {out / 'take'} was made from, it has changed since" in capsys.readouterr().err
    assert (out / "take" / "points.parquet").read_bytes() == before
    shutil.rmtree(out / "take")
    assert main(command) == 0
    assert (out / "take" / "points.parquet").read_bytes() != before
