"""`improvo improve` as a user meets it: what it says, and one line for what it cannot work with."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from rendered_walk import write_walk

from improvement_example import FakeTraining
from improvo import config
from improvo.cli.main import main
from improvo.improvement.settings import ImproveSettings

OPTIONS = [
    *("--frontend", "superpoint-small", "--max-keypoints", "250", "--set", "labels.min_observations=6"),
    *("--set", "validation.gaps=[4,8]", "--set", "validation.matches.pairs=6", "--set", "validation.min_pairs=2"),
    *("--set", "validation.matches.shuffles=2"),
    *("--set", "split.share=0.3", "--set", "validation.calibration_images=2"),
    *("--set", "odometry.start.min_points=20"),  # the room is mostly one wall
]


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_walk(tmp_path_factory.mktemp("walk") / "room", frames=40, seed=3)


@pytest.fixture
def training(monkeypatch: pytest.MonkeyPatch) -> FakeTraining:
    """In place of the real training, which has a test of its own."""
    fake = FakeTraining()
    monkeypatch.setattr("improvo.improvement.improve._train", fake)
    return fake


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    capsys.readouterr()
    assert main(["improve", *OPTIONS, "--set", "labels.min_observations=6", *map(str, words)]) == 2
    message = capsys.readouterr().err.strip().splitlines()[-1]
    assert message.startswith("improvo: ")
    return message


def write_frames(folder: Path, pictures: list[Any], camera: Path) -> Path:
    folder.mkdir()
    for i, picture in enumerate(pictures):
        cv2.imwrite(str(folder / f"{i:06d}.png"), picture)
    (folder / "camera.yaml").write_text((camera / "camera.yaml").read_text())
    return folder


def test_improve_says_what_it_did_and_where_the_result_is(
    walk: Path, training: FakeTraining, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, still = tmp_path / "out", walk.parent / "still"
    write_frames(still, [cv2.imread(str(walk / "000000.png"))] * 2, walk)
    words = ["improve", str(walk), "-o", str(out), "--steps", "90", "--seed", "7", *OPTIONS]
    assert main(words) == 0
    text = capsys.readouterr().out
    assert "held back, never trained on: the last 12 of 40 frames of room" in text
    assert "of its matches are right within 8 px at 4 frames (0.133 s), 8 frames (0.267 s)" in text
    assert text.index("estimate: about ") < text.index("held back, never trained on")  # before any work
    assert "12 of 12 frames tracked" in text
    assert f"weights in {out / 'weights.safetensors'}" in text
    assert (out / "report.html").is_file()
    assert [call["seed"] for call in training.calls] == [7]
    assert main([*words, "--json"]) == 0  # from what is there
    figures = json.loads(capsys.readouterr().out)
    assert figures["weights"] == str(out / "weights.safetensors")
    assert figures["kept"] in ("start", "round-1")
    settings = yaml.safe_load((out / "settings.yaml").read_text())
    for recipe in ("held", "training"):
        assert settings[recipe]["optimiser"]["steps"] == 90
        assert settings[recipe]["optimiser"]["decay_steps"] == 30
    assert settings["odometry"]["seed"] == 7
    begun = f"improvo: {out}: was begun "
    mend = "; give the same again, or another output folder"

    def differs(*words: object) -> str:
        message = refused(capsys, walk, *words, "-o", out)
        assert message.startswith(begun)
        assert message.endswith(mend)
        return message.removeprefix(begun).removesuffix(mend)

    assert differs("--steps", 91, "--seed", 7) == "with --steps 90, now with --steps 91"
    assert differs("--seed", 7) == "with --steps 90, now without --steps"
    assert differs("--steps", 90) == "with --seed 7, now with --seed 0"
    assert differs("--steps", 90, "--seed", 7, "--stride", 2) == "with --stride 1, now with --stride 2"
    assert differs("--steps", 90, "--seed", 7, "--fov", 60) == "without --fov, now with --fov 60.0"
    assert differs("--steps", 90, "--seed", 7, "--evaluate", still) == f"without --evaluate {still}"
    assert differs(still, "--steps", 90, "--seed", 7) == f"without the recording {still}"
    assert differs("--steps", 90, "--seed", 7, "--frontend", out / "weights.safetensors") == "with another --frontend"
    message = differs("--steps", 90, "--seed", 7, "--set", "held.scale=20")
    assert message == "with held.scale=28.0, now 20.0"
    assert main(["run", str(walk), "-o", str(tmp_path / "run"), "--frontend", str(out / "weights.safetensors")]) in (
        0,
        3,
    )


def test_what_shows_no_depth_is_explained(
    walk: Path, training: FakeTraining, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = cv2.imread(str(walk / "000000.png"), cv2.IMREAD_GRAYSCALE)
    still = write_frames(tmp_path / "still", [first] * 16, walk)
    message = refused(capsys, still, "-o", tmp_path / "a")
    assert "nothing could be labelled; still: " in message
    assert "record with a camera that moves sideways" in message
    K = np.array([[260, 0, 159.5], [0, 260, 119.5], [0, 0, 1]])
    turned = []
    for angle in np.radians(0.5) * np.arange(16):
        cos, sin = np.cos(angle), np.sin(angle)
        turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
        turned.append(
            cv2.warpPerspective(first, K @ turn @ np.linalg.inv(K), (320, 240), borderMode=cv2.BORDER_REFLECT)
        )
    rotating = write_frames(tmp_path / "rotating", turned, walk)
    message = refused(capsys, rotating, "-o", tmp_path / "b")
    assert "nothing could be labelled; rotating: " in message
    assert "parallax" in message
    assert not training.calls


def test_what_is_too_short_to_be_judged_is_said_before_training(
    walk: Path, training: FakeTraining, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = (walk, "-o", tmp_path / "out", "--end", "30", "--set", "validation.gaps=[20]")
    assert "has no pair of frames with poses and depth; hold back a longer" in refused(capsys, *words)
    assert not training.calls


def test_a_scene_cut_is_labelled_on_both_sides(
    walk: Path, training: FakeTraining, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = write_walk(tmp_path / "other", frames=26, seed=5)
    files = [*sorted(walk.glob("*.png"))[:26], *sorted(other.glob("*.png"))]
    cut = write_frames(tmp_path / "cut", [cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in files], walk)
    assert main(["improve", str(cut), "-o", str(tmp_path / "out"), *OPTIONS]) == 0
    assert "stable" in capsys.readouterr().out


def test_bad_arguments_are_one_line(
    walk: Path, training: FakeTraining, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert "no such file" in refused(capsys, tmp_path / "missing", "-o", out)
    assert "--steps and --minutes" in refused(capsys, walk, "-o", out, "--steps", "9", "--minutes", "2")
    assert "--steps 0" in refused(capsys, walk, "-o", out, "--steps", "0")
    assert "minutes=-1" in refused(capsys, walk, "-o", out, "--minutes", "-1")
    assert "only the recipe `held`" in refused(capsys, walk, "-o", out, "--minutes", "1", "--recipe", "tracks")
    assert "--rounds 0" in refused(capsys, walk, "-o", out, "--rounds", "0")
    assert "held back" in refused(capsys, walk, "-o", out, "--evaluate", walk)
    assert "did you mean" in refused(capsys, walk, "-o", out, "--set", "held_back.shar=0.2")
    assert "given twice" in refused(capsys, walk, walk, "-o", out)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").touch()
    assert "did not write" in refused(capsys, walk, "-o", tmp_path / "mine")


def test_config_prints_settings_that_are_read_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "improve"]) == 0
    (tmp_path / "improve.yaml").write_text(capsys.readouterr().out)
    assert config.load(ImproveSettings, tmp_path / "improve.yaml") == ImproveSettings()
