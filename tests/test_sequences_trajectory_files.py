"""Trajectory files: round trips, segments, and rows that are no poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from improvo.errors import InputError
from improvo.geometry.se3 import quat_xyzw_from_rotation, rotation_angle_deg
from improvo.geometry.trajectory_files import clean_poses, read_trajectory_report
from improvo.sequences import read_trajectory, write_trajectory
from improvo.types import Trajectory
from sequence_builders import poses


def trajectory(count: int = 6) -> Trajectory:
    return Trajectory(1403636579.25 + np.arange(count) * 0.05, poses(count))


def test_tum_round_trip_keeps_poses_times_gaps_and_segments(tmp_path: Path) -> None:
    written = trajectory()
    world_from_cam = written.world_from_cam.copy()
    world_from_cam[2] = np.nan
    written = Trajectory(written.times, world_from_cam, np.array([0, 0, -1, 1, 1, 3]))
    write_trajectory(tmp_path / "t.txt", written)
    text = (tmp_path / "t.txt").read_text()
    assert "camera-to-world, up to scale" in text.splitlines()[0]
    assert [line.split(":")[0] for line in text.splitlines() if "segment" in line] == [
        "# segment 0",
        "# segment 1",
        "# segment 3",
    ]
    read = read_trajectory(tmp_path / "t.txt")
    np.testing.assert_allclose(read.times, written.times[written.valid], atol=1e-6)
    np.testing.assert_allclose(read.world_from_cam, written.world_from_cam[written.valid], atol=1e-10)
    assert read.segment.tolist() == [0, 0, 1, 1, 3]


def test_kitti_round_trip(tmp_path: Path) -> None:
    write_trajectory(tmp_path / "poses.txt", trajectory(), "kitti")
    read = read_trajectory(tmp_path / "poses.txt")
    np.testing.assert_allclose(read.world_from_cam, poses(6), atol=1e-10)
    np.testing.assert_allclose(read.times, np.arange(6) / 10)


def test_euroc_columns(tmp_path: Path) -> None:
    header = "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"
    rows = []
    for i, pose in enumerate(poses(3)):
        x, y, z, w = quat_xyzw_from_rotation(pose[:3, :3])
        numbers = ",".join(repr(float(value)) for value in (*pose[:3, 3], w, x, y, z))
        rows.append(f"{1403636579763555584 + i * 50000000},{numbers},0,0,0\n")
    (tmp_path / "data.csv").write_text(header + "".join(rows))
    read = read_trajectory(tmp_path / "data.csv")
    np.testing.assert_allclose(read.world_from_cam, poses(3), atol=1e-12)
    np.testing.assert_allclose(np.diff(read.times), 0.05, atol=1e-6)


def test_bad_rows_are_counted_and_named(tmp_path: Path) -> None:
    file = tmp_path / "t.txt"
    file.write_text(
        "# timestamp tx ty tz qx qy qz qw\n"
        "0 0 0 0 0 0 0 1\n"
        "1 nan 0 0 0 0 0 1\n"
        "2 0 0 0 0 0 0 0\n"
        "3 0 0 0 0 0 0 1.5\n"
        "5 0 0 0 0 0 0 1\n"
        "4 1 0 0 0 0 0 1.001\n"
        "4 2 0 0 0 0 0 1\n"
        "6 0 0\n"
        "seven 0 0 0 0 0 0 1\n"
    )
    read, problems = read_trajectory_report(file)
    assert read.times.tolist() == [0, 1, 2, 3, 4, 5]
    assert read.valid.tolist() == [True, False, False, False, True, True]
    assert read.camera_centers[4].tolist() == [1, 0, 0]
    report = "\n".join(problems)
    assert "1 rows without a pose: NaN or infinite (line 3)" in report
    assert "2 rows without a pose: not a rigid motion (lines 4, 5)" in report
    assert "2 rows without a pose: not numbers (lines 9, 10)" in report
    assert "1 rows repeat a time stamp" in report
    assert all(str(file) in problem for problem in problems)


def test_a_bad_row_of_kitti_keeps_its_place(tmp_path: Path) -> None:
    rows = [f"1 0 0 {number} 0 1 0 0 0 0 1 0" for number in range(6)]
    rows[2], rows[3] = "1 0 0 two 0 1 0 0 0 0 1 0", "1 0 0"
    (tmp_path / "00.txt").write_text("\n".join(rows) + "\n")
    read, problems = read_trajectory_report(tmp_path / "00.txt")
    assert read.times.tolist() == [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]
    assert read.camera_centers[read.valid, 0].tolist() == [0, 1, 4, 5]
    assert [problem for problem in problems if "NaN" in problem] == []
    assert "2 rows without a pose: not numbers (lines 3, 4)" in "\n".join(problems)
    (tmp_path / "times.txt").write_text("".join(f"{0.5 * number}\n" for number in range(6)))
    assert read_trajectory(tmp_path / "00.txt").times[-1] == 2.5


def test_a_row_without_a_time_is_named(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text("0 0 0 0 0 0 0 1\nnan 1 0 0 0 0 0 1\n2 2 0 0 0 0 0 1\n")
    read, problems = read_trajectory_report(tmp_path / "t.txt")
    assert read.times.tolist() == [0, 2]
    assert "1 rows without a pose: no time (line 2)" in "\n".join(problems)


def test_slightly_scaled_rotations_are_projected_and_others_refused() -> None:
    matrices = poses(3)
    matrices[0, :3, :3] *= 1 + 3e-4
    matrices[1, :3, :3] *= 1.1
    matrices[2, :3, 0] *= -1
    cleaned, not_finite, not_rigid = clean_poses(matrices)
    assert rotation_angle_deg(cleaned[0, :3, :3].T @ poses(3)[0, :3, :3]) < 1e-6
    np.testing.assert_allclose(cleaned[0, :3, :3].T @ cleaned[0, :3, :3], np.eye(3), atol=1e-12)
    assert not_finite.tolist() == []
    assert not_rigid.tolist() == [1, 2]


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("", "is no trajectory"),
        ("hello world\n", "is no trajectory"),
        ("1 2 3\n", "is no trajectory"),
        ("0 nan 0 0 0 0 0 1\n1 0 0 0 0 0 0 0\n", "has no valid pose"),
        ("1 2 3 4 5 6 7 8 9 10 11 12\n", "has no valid pose"),
    ],
)
def test_files_without_any_pose_are_one_line_errors(tmp_path: Path, content: str, reason: str) -> None:
    file = tmp_path / "t.txt"
    file.write_text(content)
    with pytest.raises(InputError, match=reason) as error:
        read_trajectory(file)
    assert str(file) in str(error.value)
    assert "\n" not in str(error.value)


def test_binary_and_missing_files_are_one_line_errors(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_bytes(bytes(range(256)))
    for name in ("t.txt", "none.txt"):
        with pytest.raises(InputError, match=name):
            read_trajectory(tmp_path / name)


def test_kitti_cannot_be_written_with_gaps(tmp_path: Path) -> None:
    gap = trajectory()
    gap.world_from_cam[1] = np.nan
    with pytest.raises(InputError, match="TUM"):
        write_trajectory(tmp_path / "poses.txt", gap, "kitti")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("step", [1.0, 10.0, 5000.0])
def test_what_we_wrote_is_read_in_seconds_whatever_its_steps(tmp_path: Path, step: float) -> None:
    """Frames of a time lapse are a whole number of seconds apart, which in other files would be milliseconds."""
    times = step * np.arange(4)
    write_trajectory(tmp_path / "t.txt", Trajectory(times, poses(4)))
    read, notes = read_trajectory_report(tmp_path / "t.txt")
    np.testing.assert_allclose(read.times, times)
    assert notes == ()
