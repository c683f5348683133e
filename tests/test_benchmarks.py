"""What the benchmarks count: each number is of what its table says, and what cannot be told is not told."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.fixture
def judge(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    pytest.importorskip("scipy")
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import judge

    return judge


def recording(folder: Path, name: str, poses: str = "poses") -> Any:
    """A recording held back, as far as the shares that are kept depend on it."""
    own = folder / name
    own.mkdir(parents=True, exist_ok=True)
    (own / "trajectory.txt").write_text(poses)
    part = SimpleNamespace(name=name, labeled=SimpleNamespace(folder=own))
    return SimpleNamespace(part=part, pairs={"judge 30": np.array([[0, 30]])})


def test_kept_shares_are_of_one_recording_one_run_its_pairs_and_the_content_of_the_weights(
    judge: ModuleType, tmp_path: Path
) -> None:
    for folder, content in (("a", b"one"), ("b", b"two")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "weights.safetensors").write_bytes(content)
    first, second = (tmp_path / folder / "weights.safetensors" for folder in "ab")
    kitchen = recording(tmp_path / "out" / "reference", "kitchen")
    other_pairs = recording(tmp_path / "out" / "reference", "kitchen")
    other_pairs.pairs["judge 60"] = np.array([[0, 60]])
    others = [
        judge.scores_file(tmp_path, recording(tmp_path / "out" / "reference", "office"), "new", first),
        judge.scores_file(tmp_path, recording(tmp_path / "again" / "out" / "reference", "kitchen"), "new", first),
        judge.scores_file(tmp_path, other_pairs, "new", first),
        judge.scores_file(tmp_path, kitchen, "new", second),
    ]
    own = judge.scores_file(tmp_path, kitchen, "new", first)
    assert len({own, *others}) == 5
    assert judge.scores_file(tmp_path, kitchen, "new", first) == own
    run_again = recording(tmp_path / "out" / "reference", "kitchen", "other poses")
    assert judge.scores_file(tmp_path, run_again, "new", first) != own


def test_one_pair_has_no_interval(judge: ModuleType) -> None:
    before, after = {"judge 30": [[0.5]]}, {"judge 30": [[0.55]]}
    pairs = {"judge 30": np.stack([np.arange(10), np.arange(10) + 30], axis=1)}
    assert (
        judge._gain(before, after, ["judge 30"], 0, {"judge 30": pairs["judge 30"][:1]})
        == "+10.0 % (too few pairs for an interval)"
    )
    many = {"judge 30": 10 * [[0.5]]}, {"judge 30": 10 * [[0.55]]}
    assert judge._gain(*many, ["judge 30"], 0, pairs) == "+10.0 % (+10.0 to +10.0)"


def test_nothing_compared_is_not_unchanged(tmp_path: Path) -> None:
    same = {"label": {"tracks.parquet": {"sorted": "1"}}}
    for name, content in (("a", same), ("b", same), ("none", {})):
        (tmp_path / f"{name}.json").write_text(json.dumps(content))

    def compared(first: str, second: str) -> subprocess.CompletedProcess[str]:
        files = [str(tmp_path / f"{name}.json") for name in (first, second)]
        command = [sys.executable, str(BENCHMARKS / "unchanged.py"), "--compare", *files]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    fine = compared("a", "b")
    assert fine.returncode == 0
    assert "1 of 1 tasks" in fine.stdout
    assert "without results in either: " in fine.stdout
    assert compared("none", "none").returncode == 1
    assert compared("a", "none").returncode == 1


@pytest.mark.parametrize(
    ("truth", "is_wrong", "letters"),
    [("all", False, "R" * 40), ("none", False, "?" * 40), ("other", True, "w" * 40), ("standing", True, "w" * 40)],
)
def test_where_the_truth_is_missing_nothing_is_wrong(
    monkeypatch: pytest.MonkeyPatch, truth: str, is_wrong: bool, letters: str
) -> None:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import robustness_measures as measures
    from improvo.odometry.result.segments import Segment
    from improvo.types import Trajectory

    def path(x: Any, y: Any) -> Any:
        poses = np.tile(np.eye(4), (40, 1, 1))
        poses[:, :3, 3] = np.stack([x, y, 0 * x], axis=1)
        return poses

    times, turn = np.arange(40) / 30, np.linspace(0, 6, 40)
    circle, line = path(np.cos(turn), np.sin(turn)), path(turn, 0 * turn)
    estimate = Trajectory(times, circle, np.zeros(40, np.int64))
    true = {"all": circle, "none": circle * np.nan, "other": line, "standing": 0 * line + np.eye(4)}
    known = Trajectory(times, true[truth])
    rotation_wrong = measures._rotation_wrong(estimate, known)
    judged = measures._judged(Segment(0, 0, 39, 40, 0.3, "end"), estimate, known, rotation_wrong, [])
    assert (judged.wrong, judged.right) == (is_wrong, truth == "all")
    clip = SimpleNamespace(trackable=np.ones(40, bool))
    assert measures._frames(clip, estimate, rotation_wrong, [judged]) == letters
