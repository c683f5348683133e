"""What `improvo label` says of recordings that cannot be labelled, or not all of them; the rest is finished."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendered_walk import write_walk

from improvo.cli.main import main
from improvo.labeling.labeled import read_labels
from improvo.labeling.store import DONE, SequenceRecord, read_records

OPTIONS = ["--frontend", "orb", "--max-keypoints", "300", "--set", "labels.min_observations=6"]
FRAMES = 34  # of fewer the odometry knows too little of its error


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walk(tmp_path_factory.mktemp("walks") / "good", frames=FRAMES)


@pytest.fixture(scope="module")
def store(good: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One store over recordings with one trouble each."""
    folder = tmp_path_factory.mktemp("troubles")
    other = write_walk(folder / "other", frames=FRAMES, seed=5)
    images = [cv2.imread(str(good / f"{i:06d}.png"), cv2.IMREAD_GRAYSCALE) for i in range(FRAMES)]
    cut = [cv2.imread(str(other / f"{i:06d}.png"), cv2.IMREAD_GRAYSCALE) for i in range(FRAMES)]
    black = np.zeros_like(images[0])
    rng = np.random.default_rng(0)
    still = [np.clip(images[0] + rng.normal(0, 2, black.shape), 0, 255).astype(np.uint8) for _ in range(10)]
    contents = {
        "black-between": [*images[:16], black, black, black, *images[19:]],
        "black-only": [black] * 6,
        "cut": [*images, *cut],
        "still": still,
        "ten": images[:10],
        "two": images[:2],
        "torn": images,
    }
    paths = [_write(folder / name, frames, good) for name, frames in contents.items()]
    torn = folder / "torn" / "000009.png"
    torn.write_bytes(torn.read_bytes()[:2000])
    store = folder / "labels"
    assert main(["label", *map(str, paths), str(folder / "nowhere"), "-o", str(store), *OPTIONS]) == 0
    return store


@pytest.fixture(scope="module")
def records(store: Path) -> dict[str, SequenceRecord]:
    return {record.name: record for record in read_records(store)}


def _write(folder: Path, frames: list[np.ndarray], like: Path) -> Path:
    folder.mkdir()
    for i, image in enumerate(frames):
        cv2.imwrite(str(folder / f"{i:06d}.png"), image)
    shutil.copy(like / "camera.yaml", folder)
    return folder


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("black-only", "no frame got a pose"),
        ("still", "too little parallax"),
        ("two", "odometry needs at least 3"),
        ("nowhere", "no such file"),
    ],
)
def test_what_cannot_be_labelled_has_its_reason(records: dict[str, SequenceRecord], name: str, reason: str) -> None:
    assert records[name].state != DONE
    assert reason in records[name].reason
    assert "\n" not in records[name].reason


@pytest.mark.parametrize(
    ("name", "note"),
    [
        ("black-between", "3 without a pose (first: frame 16,"),
        ("cut", f"tracking began anew at frame {FRAMES}"),
        ("torn", "1 unreadable (first: frame 9, the image is truncated)"),
    ],
)
def test_what_can_is_labelled_and_the_rest_explained(records: dict[str, SequenceRecord], name: str, note: str) -> None:
    assert records[name].state == DONE
    assert records[name].stable > 5
    assert note in records[name].notes


def test_ten_frames_are_labelled_or_explained(records: dict[str, SequenceRecord]) -> None:
    record = records["ten"]
    assert record.stable + record.unstable > 0 if record.state == DONE else record.reason


def test_pure_rotation_is_explained(good: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = cv2.imread(str(good / "000000.png"), cv2.IMREAD_GRAYSCALE)
    K = np.array([[260.0, 0, 159.5], [0, 260.0, 119.5], [0, 0, 1]])
    turned = []
    for i in range(16):
        rotation, _ = cv2.Rodrigues(np.array([0.0, 0.012 * i, 0.0]))
        turned.append(cv2.warpPerspective(image, K @ rotation @ np.linalg.inv(K), (320, 240)))
    folder = _write(tmp_path / "turned", turned, good)
    assert main(["label", str(folder), "-o", str(tmp_path / "labels"), *OPTIONS]) == 2
    assert "a rotation explains the motion" in capsys.readouterr().err


def test_a_full_disk_fails_what_does_not_fit_and_finishes_the_rest(store: Path, good: Path, tmp_path: Path) -> None:
    """Files may not grow over a limit that only the longer recording exceeds."""
    resource = pytest.importorskip("resource", reason="needs a limit on the size of files")
    longer = write_walk(tmp_path / "longer", frames=2 * FRAMES)
    limit = (store / "torn" / "tracks.parquet").stat().st_size * 4 // 3  # `good` has one frame more
    store = tmp_path / "labels"
    run = subprocess.run(
        [sys.executable, "-m", "improvo", "label", str(longer), str(good), "-o", str(store), *OPTIONS],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert "longer: not labelled: " in run.stdout
    assert "cannot be written" in run.stdout
    assert "Traceback" not in run.stderr
    assert [sequence.name for sequence in read_labels(store)] == ["good"]
    assert not [path for path in store.rglob("*") if ".partial" in path.name]


def test_labels_that_are_all_withheld_still_tell_what_was_tracked(good: Path, tmp_path: Path) -> None:
    store = tmp_path / "labels"
    strict = ["--set", "labels.quality.enabled=true", "--set", "labels.quality.min_median_parallax_deg=80"]
    assert main(["label", str(good), "-o", str(store), *OPTIONS, *strict]) == 2
    (record,) = read_records(store)
    assert record.state != DONE
    assert record.tracked > FRAMES // 2
    assert record.segments >= 1
    assert record.withheld > 5
    assert f"{record.withheld} withheld: its frames are not to be trusted, " in record.reason
    assert "of little parallax" in record.reason
    assert "of a doubtful path" not in record.reason
    assert "record with a camera that moves" in record.reason
    assert not (store / record.name).exists()


def test_a_calibration_or_mask_for_all_that_is_not_there_is_said_before_any_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for option, what in (
        ("--camera", "nothing.yaml: no such file"),
        ("--mask", "nothing.yaml: no such file or folder"),
    ):
        assert main(["label", "demo", "-o", str(tmp_path / "labels"), option, str(tmp_path / "nothing.yaml")]) == 2
        message = capsys.readouterr().err.strip()
        assert what in message
        assert "\n" not in message
    assert list(tmp_path.iterdir()) == []
