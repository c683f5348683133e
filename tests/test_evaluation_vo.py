"""`improvo evaluate trajectory` and `improvo evaluate vo`: files in, tables out, errors in one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from evaluation_scene import CAMERA, PlaneFeatures, PlaneSequence
from improvo.cli.main import main
from improvo.errors import ConfigError, InputError, MissingExtraError
from improvo.evaluation.settings import TrajectorySettings
from improvo.evaluation.sources import LoadedFrontend
from improvo.evaluation.trajectory.tables import vo_tables
from improvo.evaluation.vo.protocol import WITH, WITHOUT, evaluate_vo, usable
from improvo.frontend import Frontend
from improvo.geometry.se3 import rigid, so3_exp
from improvo.geometry.trajectory_files import write_trajectory
from improvo.odometry.settings import OdometrySettings
from improvo.simulation import bundled_sequence
from improvo.types import Features, Frame, Trajectory, UInt8


def trajectory(seconds: float = 6.0) -> Trajectory:
    times = np.arange(int(seconds * 10) + 1) / 10
    turn = np.column_stack([0.1 * times, 0.2 * times, 0 * times])
    return Trajectory(times, rigid(so3_exp(turn), np.column_stack([times, np.sin(times), 0.1 * times])))


def test_trajectory_command_prints_tables_and_leaves_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = trajectory()
    poses = truth.world_from_cam.copy()
    poses[:, :3, 3] *= 0.5
    segment = (np.arange(len(truth)) > 40).astype(np.int64)
    write_trajectory(tmp_path / "truth.txt", truth)
    write_trajectory(tmp_path / "estimate.txt", Trajectory(truth.times, poses, segment))
    words = ["evaluate", "trajectory", str(tmp_path / "estimate.txt"), str(tmp_path / "truth.txt")]
    assert main([*words, "--distances", "1", "-o", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert "| No prediction" in printed
    assert "no window of 10 s: the longest segment is 4 s" in printed
    assert "nan" not in printed
    found = json.loads((tmp_path / "out" / "trajectory.json").read_text())
    assert [s["scale"] for s in found["segments"]] == pytest.approx([2.0, 2.0])
    assert found["ate_m"]["rmse"] < 1e-6
    assert main([*words, "--alignment", "se3"]) == 0
    assert "alignment se3" in capsys.readouterr().out


def test_kitti_files_of_one_length_count_the_same_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    truth = trajectory()
    for name in ("estimate", "truth"):
        (tmp_path / name).mkdir()
        write_trajectory(tmp_path / name / "poses.txt", truth, "kitti")
    (tmp_path / "truth" / "times.txt").write_text("".join(f"{time * 1.037:.6e}\n" for time in truth.times))
    words = ["evaluate", "trajectory", str(tmp_path / "estimate" / "poses.txt"), str(tmp_path / "truth" / "poses.txt")]
    assert main(words) == 0
    assert capsys.readouterr().out.startswith("61 poses at a common time")


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda path: path.write_text("no numbers here\n"), "trajectory"),
        (lambda path: path.write_text("100 0 0 0 0 0 0 1\n101 0 0 1 0 0 0 1\n"), "no common time"),
        (lambda path: path.write_text("0 nan 0 0 0 0 0 1\n"), "no valid pose"),
        (lambda path: None, "no such file"),
    ],
)
def test_bad_trajectories_are_one_line_errors(
    tmp_path: Path, write: Any, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    write_trajectory(tmp_path / "truth.txt", trajectory())
    write(tmp_path / "estimate.txt")
    assert main(["evaluate", "trajectory", str(tmp_path / "estimate.txt"), str(tmp_path / "truth.txt")]) == 2
    error = capsys.readouterr().err.strip()
    assert message in error
    assert "\n" not in error
    assert "estimate.txt" in error


def test_vo_on_a_real_sequence(shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["evaluate", "vo", str(shared_data / "hololens-office"), "--stride", "1", "--max-frames", "24"]
    words += ["--frontend", "orb", "--workers", "1", "--windows", "2", "60", "-o", str(tmp_path / "out")]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "orb has no stability head" in printed
    assert "no window of 60 s" in printed
    found = json.loads((tmp_path / "out" / "vo.json").read_text())
    row = found["rows"][0]
    assert row["tracked"] > 15
    window = row["relative"][0]
    assert window["translation_m"]["mean"] < 0.3 * window["no_prediction_translation_m"]
    assert (tmp_path / "out" / "orb" / "hololens-office.txt").stat().st_size > 500


class StabilityFrontend:
    """Sees the true points, some of which jump about; its stability head knows which."""

    name = "knowing"

    def __init__(self, sequence: PlaneSequence) -> None:
        self._sequence = sequence
        self._next = 0

    def __call__(self, image: UInt8) -> Features:
        frame = Frame(self._next, 0.0, image, "")
        self._next += 1
        features = PlaneFeatures(noise=0.2).features(self._sequence, frame)
        jumping = features.descriptors[:, 0] > 0.15  # about a fifth, the same points in every frame
        rng = np.random.default_rng(frame.source_index)
        keypoints = features.keypoints + rng.uniform(-6, 6, features.keypoints.shape) * jumping[:, None]
        stability = np.where(jumping, 0.001, 1.0).astype(np.float32)
        return Features(keypoints.astype(np.float32), features.descriptors, features.scores, stability)


class IterablePlane(PlaneSequence):
    """A plane sequence that the odometry can run on."""

    @property
    def recording(self) -> Any:
        return self

    def __iter__(self) -> Any:
        return (self[i] for i in range(len(self)))


class IterableSource:
    path = "/scenes/plane"

    def open(self) -> Any:
        return IterablePlane(frames=40)


def test_table_2_compares_both_variants_on_the_same_features(monkeypatch: pytest.MonkeyPatch) -> None:
    def knowing(name: str, max_keypoints: int) -> Frontend:
        return StabilityFrontend(IterablePlane(frames=40))

    monkeypatch.setattr("improvo.evaluation.vo.protocol.load_frontend", knowing)
    settings = TrajectorySettings(time_windows=(0.5,))
    sources: Any = [IterableSource()]
    outcomes, found = evaluate_vo(sources, [LoadedFrontend("knowing", 500)], OdometrySettings(mode="paper"), settings)
    assert [o.variant for o in outcomes] == [WITHOUT, WITH]
    assert [row["variant"] for row in found["rows"]] == [WITHOUT, WITH]
    errors = [row["relative"][0]["translation_m"]["mean"] for row in found["rows"]]
    assert errors[1] < errors[0]  # knowing which points jump helps
    text = vo_tables(found)
    assert f"knowing {WITH}" in text
    assert "| No prediction" in text
    assert CAMERA.width == 160


def test_odometry_that_finds_no_pose_is_told_as_such(monkeypatch: pytest.MonkeyPatch) -> None:
    class Blind:
        name = "blind"

        def __call__(self, image: UInt8) -> Features:
            return Features(np.zeros((0, 2), np.float32), np.zeros((0, 8), np.float32), np.zeros(0, np.float32))

    monkeypatch.setattr("improvo.evaluation.vo.protocol.load_frontend", lambda name, max_keypoints: Blind())
    rest = OdometrySettings(), TrajectorySettings(time_windows=(0.5,))
    (outcome,), _ = evaluate_vo([IterableSource()], [LoadedFrontend("blind")], *rest)  # type: ignore[list-item]
    assert (outcome.note, outcome.errors, outcome.segments) == ("odometry found no pose", None, [])


def test_two_weights_files_of_one_name_need_labels(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def knowing(name: str, max_keypoints: int) -> Frontend:
        asked.append((name, max_keypoints))
        return StabilityFrontend(IterablePlane(frames=40))

    monkeypatch.setattr("improvo.evaluation.vo.protocol.load_frontend", knowing)
    sources: Any = [IterableSource()]
    files = ["first/weights.safetensors", "second/weights.safetensors"]
    rest = OdometrySettings(mode="paper"), TrajectorySettings(time_windows=(0.5,))
    with pytest.raises(ConfigError, match="frontends: `weights` is given twice; name one by LABEL=NAME"):
        evaluate_vo(sources, [LoadedFrontend(file) for file in files], *rest)
    for labels, folder in ((["a b", "a_b"], "a_b"), (["a/b", "a_b"], "a_b")):
        with pytest.raises(ConfigError, match=f"`{labels[0]}` and `{labels[1]}` would share the folder `{folder}`"):
            evaluate_vo(sources, [LoadedFrontend(f, 300, label) for f, label in zip(files, labels, strict=True)], *rest)
    with pytest.raises(ConfigError, match="sequences: `plane` is given twice; rename one"):
        evaluate_vo(sources * 2, [LoadedFrontend(files[0])], *rest)
    assert not asked
    named = [LoadedFrontend(file, 300, label) for file, label in zip(files, ("before", "after"), strict=True)]
    outcomes, found = evaluate_vo(sources, named, *rest)
    assert asked == [(files[0], 300), (files[1], 300)]
    rows = [(row["frontend"], row["variant"], row["sequences"]) for row in found["rows"]]
    assert rows == [("before", WITHOUT, 1), ("before", WITH, 1), ("after", WITHOUT, 1), ("after", WITH, 1)]
    assert [outcome.frontend for outcome in outcomes] == ["before", "before", "after", "after"]


def test_the_command_says_what_it_takes_and_what_it_left_out(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SystemExit):
        main(["evaluate", "vo", "--help"])
    told = " ".join(capsys.readouterr().out.split())
    assert "LABEL=NAME names its row; repeatable (default: superpoint-vo)" in told
    assert "xfeat" not in told
    demo = str(bundled_sequence())
    assert main(["evaluate", "vo", demo, "--frontend", "mine=xfeat"]) == 2
    assert "--frontend xfeat: odometry has only our own frontends" in capsys.readouterr().err

    def check(self: LoadedFrontend) -> None:
        if self.name not in ("orb", "sift"):
            raise MissingExtraError(f"frontend {self.name}", "surf")

    monkeypatch.setattr(LoadedFrontend, "check", check)
    words = ["evaluate", "vo", demo, "--frontend", "all", "--frontend", "my orb=orb", "--max-frames", "20"]
    assert main([*words, "--stride", "1", "--windows", "0.3", "--workers", "1", "-o", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert "- frontend surf not run: " in printed
    assert "xfeat" not in printed
    found = json.loads((tmp_path / "out" / "vo.json").read_text())
    assert [row["frontend"] for row in found["rows"]] == ["my orb", "sift", "orb"]
    assert {entry["frontend"] for entry in found["skipped_frontends"]} >= {"surf", "superpoint-vo"}
    for folder in ("my_orb", "sift", "orb"):
        assert (tmp_path / "out" / folder / "demo.txt").stat().st_size > 500


def test_sequences_with_invalid_truth_are_left_out_and_named() -> None:
    class Broken(IterablePlane):
        @property
        def ground_truth(self) -> Trajectory | None:
            truth = super().ground_truth
            assert truth is not None
            truth.world_from_cam[3] = np.nan
            return truth

    class BrokenSource(IterableSource):
        def open(self) -> Any:
            return Broken(name="broken")

    sources: Any = [IterableSource(), BrokenSource()]
    chosen, excluded = usable(sources)
    assert chosen == sources[:1]
    assert excluded[0].sequence == "broken"
    assert excluded[0].reason.startswith("1 of 20 true poses")
    with pytest.raises(InputError, match="no sequence is left"):
        usable(sources[1:])


def test_exported_images_are_the_frames_of_the_pairs(shared_data: Path, tmp_path: Path) -> None:
    words = ["evaluate", "pose", str(shared_data / "hololens-office"), "--gaps", "2", "--pairs", "3"]
    assert main([*words, "--export-images", str(tmp_path / "images")]) == 0
    written = sorted((tmp_path / "images" / "hololens-office").glob("*.png"))
    assert 4 <= len(written) <= 6
