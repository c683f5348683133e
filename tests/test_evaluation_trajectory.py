"""The trajectory protocol, against known truths, evo as a separate program, and rpg's definitions written anew."""

from __future__ import annotations

import itertools
import json
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

import sequence_encoders as encoders
from fuzz_targets import scene
from improvo.errors import ConfigError, InputError
from improvo.evaluation.settings import TrajectorySettings
from improvo.evaluation.trajectory.protocol import associate, clean_truth, evaluate_trajectory
from improvo.evaluation.trajectory.relative import window_pairs
from improvo.geometry.alignment import Similarity
from improvo.geometry.se3 import nearest_rotation, rigid, so3_exp
from improvo.geometry.trajectory_files import read_trajectory
from improvo.sequences import open_recording
from improvo.types import Float64, Trajectory

RNG_SEED = 7


def wander(seconds: float, rate: float, seed: int = RNG_SEED) -> Trajectory:
    """A smooth random walk with turning."""
    rng = np.random.default_rng(seed)
    count = int(seconds * rate) + 1
    turn = np.cumsum(np.cumsum(rng.normal(0, 2e-3, (count, 3)), axis=0), axis=0)
    velocity = np.array([0.02, 0, 0]) + np.cumsum(rng.normal(0, 2e-3, (count, 3)), axis=0)
    positions = np.cumsum(velocity, axis=0)
    return Trajectory(np.arange(count) / rate, rigid(so3_exp(turn), positions))


def perturbed(truth: Trajectory, seed: int, degrees: float, metres: float) -> Trajectory:
    rng = np.random.default_rng(seed)
    poses = np.array(truth.world_from_cam)
    poses[:, :3, :3] = poses[:, :3, :3] @ so3_exp(rng.normal(0, np.radians(degrees), (len(poses), 3)))
    poses[:, :3, 3] += rng.normal(0, metres, (len(poses), 3))
    return Trajectory(truth.times, poses)


def moved(trajectory: Trajectory, scale: float) -> Trajectory:
    motion = Similarity(scale, so3_exp(np.array([0.3, -1.1, 0.4])), np.array([4.0, -2.0, 1.0]))
    return Trajectory(trajectory.times, motion.apply_to_poses(trajectory.world_from_cam))


def test_the_truth_moved_and_scaled_has_no_error() -> None:
    truth = wander(12, 10)
    errors = evaluate_trajectory(moved(truth, 0.37), truth)
    assert errors.poses == len(truth)
    assert errors.ate_m is not None
    assert errors.ate_m.maximum < 1e-9
    assert errors.segments[0].scale == pytest.approx(1 / 0.37)
    for row in errors.relative:
        assert row.windows > 0
        assert row.rotation_deg is not None
        assert row.translation_m is not None
        assert row.rotation_deg.maximum < 1e-6
        assert row.translation_m.maximum < 1e-9
        assert row.no_prediction_translation_m is not None
        assert row.no_prediction_translation_m > 0.1


def test_alignment_none_and_se3_do_not_forgive_what_sim3_forgives() -> None:
    truth = wander(6, 10)
    ate = {}
    for alignment in ("none", "se3", "sim3"):
        errors = evaluate_trajectory(moved(truth, 0.5), truth, TrajectorySettings(alignment=alignment))
        assert errors.ate_m is not None
        ate[alignment] = errors.ate_m.rmse
    assert ate["none"] > 1.0
    assert 0.01 < ate["se3"] < ate["none"]
    assert ate["sim3"] < 1e-9


def test_noise_of_known_size_is_measured() -> None:
    truth = wander(200, 10)
    settings = TrajectorySettings(alignment="none", time_windows=(2.0,), path_fractions=(0.5,))
    errors = evaluate_trajectory(perturbed(truth, 1, degrees=1.0, metres=0.02), truth, settings)
    assert errors.ate_m is not None
    assert errors.rotation_deg is not None
    assert errors.ate_m.rmse == pytest.approx(0.02 * np.sqrt(3), rel=0.05)
    assert errors.rotation_deg.rmse == pytest.approx(np.sqrt(3), rel=0.05)
    window = errors.relative[0]
    assert window.rotation_deg is not None
    assert window.rotation_deg.rmse == pytest.approx(np.sqrt(6), rel=0.05)  # two independent ends


def test_segments_of_different_scale_are_aligned_each_on_its_own() -> None:
    truth = wander(20, 10)
    half = len(truth) // 2
    first, second = moved(truth, 0.2), moved(truth, 3.0)
    poses = np.concatenate([first.world_from_cam[:half], second.world_from_cam[half:]])
    poses[half - 5 : half + 5] = np.nan
    segment = np.where(np.isnan(poses[:, 0, 0]), -1, (np.arange(len(truth)) >= half).astype(np.int64))
    apart = evaluate_trajectory(Trajectory(truth.times, poses, segment), truth)
    assert [s.scale for s in apart.segments] == pytest.approx([5.0, 1 / 3.0])
    assert apart.poses == len(truth) - 10
    assert apart.ate_m is not None
    assert apart.ate_m.maximum < 1e-9
    ten = next(row for row in apart.relative if row.length == 10.0 and row.unit == "s")
    assert ten.windows == 0  # none may bridge the gap
    assert "longest segment" in ten.note
    together = evaluate_trajectory(Trajectory(truth.times, poses), truth)
    assert together.ate_m is not None
    assert together.ate_m.rmse > 0.1


def test_a_short_segment_is_named_and_does_not_spoil_the_rest() -> None:
    truth = wander(5, 10)
    segment = np.zeros(len(truth), np.int64)
    segment[-2:] = 1
    errors = evaluate_trajectory(Trajectory(truth.times, moved(truth, 2.0).world_from_cam, segment), truth)
    assert errors.segments[1].ate_m is None
    assert "at least 3" in errors.segments[1].note
    assert errors.ate_m is not None
    assert errors.ate_m.maximum < 1e-9


def test_a_window_longer_than_the_trajectory_says_so() -> None:
    truth = wander(5, 10)
    ten = evaluate_trajectory(truth, truth, TrajectorySettings(time_windows=(10.0,))).relative[0]
    assert ten.windows == 0
    assert ten.rotation_deg is None
    assert ten.note == "no window of 10 s: the longest segment is 5 s"


def test_association_is_mutual_and_within_the_tolerance() -> None:
    pairs = associate(np.array([0.0, 0.1, 0.104, 0.3, 0.5]), np.array([0.002, 0.105, 0.32, 0.55]), 0.02)
    assert pairs.tolist() == [[0, 0], [2, 1], [3, 2]]


def test_windows_by_time_of_a_regular_recording_are_all_frame_pairs() -> None:
    times = 1000.0 + np.arange(100) * 0.1
    assert window_pairs(times, 2.0, 0.4, 0.05).tolist() == [[i, i + 20] for i in range(80)]


def test_invalid_true_poses_are_left_out_and_named() -> None:
    truth = wander(5, 10)
    poses = np.array(truth.world_from_cam)
    poses[3] = np.nan
    poses[7, :3, :3] *= 1.5
    poses[9, :3, :3] *= 1 + 1e-3  # printed digits: repaired
    errors = evaluate_trajectory(truth, Trajectory(truth.times, poses))
    assert errors.invalid_truth == pytest.approx((0.3, 0.7))
    assert errors.poses == len(truth) - 2
    repaired, unusable = clean_truth(Trajectory(truth.times, poses))
    assert unusable.sum() == 2
    assert np.linalg.det(repaired.world_from_cam[9, :3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("estimate_shift", "poses_are_nan", "message"),
    [(100.0, False, "no common time"), (0.0, True, "has no valid pose")],
)
def test_trajectories_that_cannot_be_compared(estimate_shift: float, poses_are_nan: bool, message: str) -> None:
    truth = wander(2, 10)
    poses = np.full_like(truth.world_from_cam, np.nan) if poses_are_nan else truth.world_from_cam
    with pytest.raises(InputError, match=message):
        evaluate_trajectory(Trajectory(truth.times + estimate_shift, poses), truth)


def test_settings_refuse_nonsense() -> None:
    with pytest.raises(ConfigError, match="alignment"):
        TrajectorySettings(alignment="umeyama")
    with pytest.raises(ConfigError, match="positive"):
        TrajectorySettings(time_windows=(2.0, -1.0))


def rpg_relative_errors(truth: Float64, estimate: Float64, length: float) -> tuple[list[float], list[float]]:
    """Zhang and Scaramuzza's relative errors by distance, written from their definition with plain loops."""
    distance = [0.0]
    for a, b in itertools.pairwise(truth):
        distance.append(distance[-1] + float(np.linalg.norm(b[:3, 3] - a[:3, 3])))
    rotations, translations = [], []
    for start, begin in enumerate(distance):
        best, smallest = -1, 0.2 * length
        for end in range(start, len(distance)):
            off = abs(distance[end] - (begin + length))
            if off < smallest:
                best, smallest = end, off
        if best < 0:
            continue
        true_motion = np.linalg.inv(truth[start]) @ truth[best]
        motion = np.linalg.inv(estimate[start]) @ estimate[best]
        error = np.linalg.inv(motion) @ true_motion
        rotations.append(np.degrees(np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1))))
        translations.append(float(np.linalg.norm(error[:3, 3])))
    return rotations, translations


def test_relative_errors_by_distance_follow_rpg() -> None:
    truth = wander(30, 10)
    estimate = perturbed(truth, 3, degrees=2.0, metres=0.05)
    settings = TrajectorySettings(alignment="se3", distance_windows=(1.0, 3.0), time_windows=(2.0,), path_fractions=())
    rows = evaluate_trajectory(estimate, truth, settings).relative[1:]
    for row in rows:
        rotations, translations = rpg_relative_errors(truth.world_from_cam, estimate.world_from_cam, row.length)
        assert row.windows == len(rotations) > 50
        assert row.rotation_deg is not None
        assert row.translation_m is not None
        assert row.rotation_deg.mean == pytest.approx(np.mean(rotations), rel=1e-9)
        assert row.translation_m.mean == pytest.approx(np.mean(translations), rel=1e-9)
        assert row.translation_percent == pytest.approx(100 * np.mean(translations) / row.length, rel=1e-9)


def evo(program: str, layout: str, truth: Path, estimate: Path, options: list[str], out: Path) -> dict[str, float]:
    """Statistics that evo prints, run as a separate program (it is GPL and never imported)."""
    executable = shutil.which(program) or shutil.which(program, path=str(Path(sys.executable).parent))
    if executable is None:
        pytest.skip(f"needs {program} on the PATH (pip install evo), run beside improvo as a program")
    out.unlink(missing_ok=True)
    command = [executable, layout, str(truth), str(estimate), *options, "--save_results", str(out), "--no_warnings"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    with zipfile.ZipFile(out) as archive:
        statistics: dict[str, float] = json.loads(archive.read("stats.json"))
    return statistics


def disturb_file(source: Path, target: Path, layout: str) -> None:
    """A believable estimate from a true trajectory file: drift, noise, another scale, every third pose missing."""
    rng = np.random.default_rng(RNG_SEED)
    rows = np.loadtxt(source)
    count = len(rows)
    drift = np.cumsum(rng.normal(0, 0.003, (count, 3)), axis=0)
    if layout == "tum":
        rows[:, 1:4] = 0.4 * (rows[:, 1:4] + drift)
        rows[:, 4:] += rng.normal(0, 0.01, (count, 4))
        rows[:, 4:] /= np.linalg.norm(rows[:, 4:], axis=1, keepdims=True)
        rows = rows[np.arange(count) % 3 > 0]
    else:
        poses = rows.reshape(-1, 3, 4)
        poses[:, :, :3] = nearest_rotation(poses[:, :, :3]) @ so3_exp(rng.normal(0, 0.01, (count, 3)))
        poses[:, :, 3] = 0.4 * (poses[:, :, 3] + 10 * drift)
        rows = poses.reshape(-1, 12)
    np.savetxt(target, rows, fmt="%.12g")


TUM_FILES = ["hololens-office/groundtruth.txt", "checkerboard-desk/groundtruth.txt", "fr3-notexture/groundtruth.txt"]


@pytest.mark.parametrize("name", [*TUM_FILES, "kitti00/poses.txt"])
def test_figures_agree_with_evo(shared_data: Path, tmp_path: Path, name: str) -> None:
    layout = "kitti" if name.startswith("kitti") else "tum"
    truth_file, estimate_file = tmp_path / "truth.txt", tmp_path / "estimate.txt"
    # evo demands exact rotations; the repaired truth is what both get
    truth = clean_truth(read_trajectory(shared_data / name))[0]
    if layout == "kitti":
        np.savetxt(truth_file, truth.world_from_cam[:, :3].reshape(-1, 12), fmt="%.15g")
    else:
        shutil.copy(shared_data / name, truth_file)
    disturb_file(truth_file, estimate_file, layout)
    estimate, truth = read_trajectory(estimate_file), read_trajectory(truth_file)

    distance = 2.0 if layout == "kitti" else 0.3
    settings = TrajectorySettings(max_time_difference=0.01, distance_windows=(distance,), time_windows=(2.0,))
    ours = {a: evaluate_trajectory(estimate, truth, settings_with(settings, a)) for a in ("none", "se3", "sim3")}
    flags = {"none": [], "se3": ["-a"], "sim3": ["-a", "-s"]}
    for alignment, errors in ours.items():
        assert errors.ate_m is not None
        assert errors.rotation_deg is not None
        theirs = evo("evo_ape", layout, truth_file, estimate_file, flags[alignment], tmp_path / "ape.zip")
        assert errors.ate_m.rmse == pytest.approx(theirs["rmse"], rel=1e-6)
        assert errors.ate_m.median == pytest.approx(theirs["median"], rel=1e-6)
        assert errors.ate_m.maximum == pytest.approx(theirs["max"], rel=1e-6)
    angles = evo("evo_ape", layout, truth_file, estimate_file, ["-a", "-r", "angle_deg"], tmp_path / "angle.zip")
    se3 = ours["se3"]
    assert se3.rotation_deg is not None
    assert se3.rotation_deg.rmse == pytest.approx(angles["rmse"], rel=1e-6)

    by_distance = next(row for row in ours["sim3"].relative if row.unit == "m")
    windows = ["-d", str(distance), "-u", "m", "-t", "0.2", "--all_pairs", "--pairs_from_reference", "-a", "-s"]
    shift = evo("evo_rpe", layout, truth_file, estimate_file, windows, tmp_path / "rpe.zip")
    angle = evo("evo_rpe", layout, truth_file, estimate_file, [*windows, "-r", "angle_deg"], tmp_path / "rpa.zip")
    assert by_distance.windows > 20
    assert by_distance.translation_m is not None
    assert by_distance.rotation_deg is not None
    assert by_distance.translation_m.rmse == pytest.approx(shift["rmse"], rel=1e-6)
    assert by_distance.translation_m.mean == pytest.approx(shift["mean"], rel=1e-6)
    assert by_distance.rotation_deg.mean == pytest.approx(angle["mean"], rel=1e-6)

    if layout == "kitti":  # 10 Hz, every pose there: 2 s are 20 frames
        frames = ["-d", "20", "-u", "f", "--all_pairs", "-a", "-s"]
        shift = evo("evo_rpe", layout, truth_file, estimate_file, frames, tmp_path / "rpf.zip")
        by_time = ours["sim3"].relative[0]
        assert by_time.translation_m is not None
        assert by_time.windows == len(truth) - 20
        assert by_time.translation_m.rmse == pytest.approx(shift["rmse"], rel=1e-6)


def settings_with(settings: TrajectorySettings, alignment: str) -> TrajectorySettings:
    from dataclasses import replace

    return replace(settings, alignment=alignment)


def test_kitti_rows_without_times_count_the_rows_of_a_timed_file(tmp_path: Path) -> None:
    from improvo.evaluation.trajectory.pair import read_pair
    from improvo.geometry.trajectory_files import write_trajectory

    truth = wander(5, 20)
    write_trajectory(tmp_path / "truth.txt", truth)
    write_trajectory(tmp_path / "kitti.txt", truth, "kitti")
    for first, second in (("kitti.txt", "truth.txt"), ("truth.txt", "kitti.txt")):
        estimate, other, notes = read_pair(tmp_path / first, tmp_path / second)
        np.testing.assert_array_equal(estimate.times, other.times)
        assert any("row by row" in note for note in notes)
        assert not any("10 poses per second" in note for note in notes)
    rows = (tmp_path / "kitti.txt").read_text().splitlines()
    (tmp_path / "kitti.txt").write_text("\n".join(rows[:-1]))
    with pytest.raises(InputError, match=r"kitti.txt: has 100 poses without times, and the other 101; put a times.txt"):
        read_pair(tmp_path / "kitti.txt", tmp_path / "truth.txt")
    (tmp_path / "times.txt").write_text("".join(f"{time}\n" for time in truth.times))
    assert len(read_pair(tmp_path / "kitti.txt", tmp_path / "truth.txt")[0]) == 100


def test_what_is_odd_in_kitti_rows_is_told_though_they_count_others(tmp_path: Path) -> None:
    from improvo.evaluation.trajectory.pair import read_pair
    from improvo.geometry.trajectory_files import write_trajectory

    truth = wander(5, 20)
    write_trajectory(tmp_path / "kitti.txt", truth, "kitti")
    rows = (tmp_path / "kitti.txt").read_text().splitlines()
    (tmp_path / "kitti.txt").write_text("\n".join([*rows[:7], "lost", *rows[8:]]))
    estimate, _, notes = read_pair(tmp_path / "kitti.txt", truth)
    assert np.flatnonzero(~estimate.valid).tolist() == [7]
    assert any("not numbers (line 8)" in note for note in notes)


def test_a_recording_of_one_file_may_be_the_truth(tmp_path: Path) -> None:
    from improvo.evaluation.trajectory.pair import read_pair

    path = encoders.write_transforms(tmp_path, scene()) / "transforms.json"
    truth = open_recording(path).ground_truth
    assert truth is not None
    _, found, _ = read_pair(truth, path)
    np.testing.assert_allclose(found.world_from_cam, truth.world_from_cam, rtol=0, atol=1e-12)


def test_the_api_holds_the_same_files_against_each_other_as_the_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import improvo
    from improvo.cli.main import main
    from improvo.geometry.trajectory_files import write_trajectory
    from improvo.simulation import bundled_sequence

    truth = wander(5, 30)
    poses_by_rate, room = tmp_path / "kitti.txt", tmp_path / "room"
    write_trajectory(tmp_path / "truth.txt", truth)
    write_trajectory(poses_by_rate, truth, "kitti")
    shutil.copytree(bundled_sequence(), room)
    (room / "camera.yaml").unlink()  # poses against poses need no camera
    with pytest.raises(InputError, match="camera"):
        improvo.open_sequence(room)
    own = tmp_path / "own.txt"
    write_trajectory(own, read_trajectory(room / "groundtruth.txt"))
    pairs = [(poses_by_rate, tmp_path / "truth.txt"), (tmp_path / "truth.txt", poses_by_rate), (own, room)]
    for estimate, against in pairs:
        errors = improvo.evaluate_trajectory(estimate, against)
        assert main(["evaluate", "trajectory", str(estimate), str(against), "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        assert (errors.poses, errors.ate_percent) == (told["poses"], told["ate_percent"])
        assert errors.poses >= 100
        assert errors.ate_percent == pytest.approx(0, abs=1e-3)
    in_memory = improvo.evaluate_trajectory(poses_by_rate, truth)
    assert in_memory.poses == len(truth)
    assert in_memory.ate_percent == pytest.approx(0, abs=1e-3)
    write_trajectory(poses_by_rate, wander(4, 30), "kitti")
    with pytest.raises(InputError, match="has 121 poses without times, and the other 151"):
        improvo.evaluate_trajectory(poses_by_rate, tmp_path / "truth.txt")
