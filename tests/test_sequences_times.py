"""Time stamps as files have them: any unit, numbered rows, dates, names; and text of any system."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from improvo.errors import InputError
from improvo.geometry.se3 import inverse, quat_xyzw_from_rotation, rigid, so3_exp
from improvo.geometry.time_units import unit_of
from improvo.geometry.trajectory_files import read_times, read_trajectory_report
from improvo.sequences import open_sequence
from improvo.sequences.opening import true_trajectory
from sequence_builders import images, poses, write_images

START = 1_700_000_000.25
COUNT = 6
TIMES = START + 0.05 * np.arange(COUNT)


def trajectory_text(times: np.ndarray, scale: float = 1.0, separator: str = " ", point: str = ".") -> str:
    lines = []
    for time, pose in zip(times, poses(len(times)), strict=True):
        numbers = [*pose[:3, 3], *quat_xyzw_from_rotation(pose[:3, :3])]
        stamp = f"{time * scale:.0f}" if scale > 1 else f"{time:.6f}"
        fields = [stamp, *(f"{value:.12f}" for value in numbers)]
        lines.append(separator.join(field.replace(".", point) for field in fields))
    return "\n".join(lines) + "\n"


def folder(path: Path, text: str | bytes, name: str = "times.txt", pattern: str = "{:05d}.png") -> Path:
    write_images(path / "images", images(COUNT), pattern)
    (path / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("".join(f"{t:.6f}\n" for t in TIMES), None),
        ("".join(f"{t * 1e3:.0f}\n" for t in TIMES), "milliseconds"),
        ("".join(f"{t * 1e6:.0f}\n" for t in TIMES), "microseconds"),
        ("".join(f"{t * 1e9:.0f}\n" for t in TIMES), "nanoseconds"),
        ("".join(f"{i:05d} {t:.6f} 8.3\n" for i, t in enumerate(TIMES)), None),
        ("".join(f"{i} {t * 1e9:.0f}\n" for i, t in enumerate(TIMES)), "nanoseconds"),
        ("#time\n" + "".join(f"{t:.6f} images/{i:05d}.png\n" for i, t in enumerate(TIMES)), None),
        ("timestamp\r\n" + "".join(f"{t:.6f}\r\n" for t in TIMES), None),
        ("\ufeff" + "".join(f"{t:.6f}\n" for t in TIMES), None),
        ("".join(f"{t:.6f}\n".replace(".", ",") for t in TIMES), None),
    ],
    ids=["s", "ms", "us", "ns", "tum-mono", "id-ns", "time-file", "header-crlf", "bom", "decimal-comma"],
)
def test_times_of_an_image_folder(tmp_path: Path, text: str, unit: str | None) -> None:
    path = folder(tmp_path / "s", text)
    (path / "groundtruth.txt").write_text(trajectory_text(TIMES))
    sequence = open_sequence(path, fov=60.0)
    np.testing.assert_allclose(sequence.times, TIMES, rtol=0, atol=2e-3 if unit == "milliseconds" else 1e-6)
    assert any(f"taken as {unit}" in note for note in sequence.notes) == (unit is not None)
    assert sequence.ground_truth is not None
    assert sequence.ground_truth.valid.all()


def test_utf_16_is_text_too(tmp_path: Path) -> None:
    path = folder(tmp_path / "s", "".join(f"{t:.6f}\r\n" for t in TIMES).encode("utf-16"))
    np.testing.assert_allclose(open_sequence(path, fov=60.0).times, TIMES, atol=1e-6)


def test_dates_and_clock_times_of_kitti(tmp_path: Path) -> None:
    (tmp_path / "t.txt").write_text("2011-09-26 13:02:25.964389445\n2011-09-26 13:02:26.067990140\n")
    times, _ = read_times(tmp_path / "t.txt")
    assert times[0] == pytest.approx(1317042145.964389445, abs=1e-6)
    assert times[1] - times[0] == pytest.approx(0.103600695, abs=1e-6)


@pytest.mark.parametrize("pattern", ["{:.6f}.png", "{:.0f}.png", "cam_{:.0f}.png"])
def test_names_that_are_time_stamps(tmp_path: Path, pattern: str) -> None:
    scale = 1.0 if ".6f" in pattern else 1e9
    for time, picture in zip(TIMES, images(COUNT), strict=True):
        write_images(tmp_path / "s", [picture], pattern.format(time * scale))
    sequence = open_sequence(tmp_path / "s", fov=60.0)
    np.testing.assert_allclose(sequence.times, TIMES, rtol=0, atol=1e-6)
    assert open_sequence(tmp_path / "s", fov=60.0, fps=10.0).times[1] == pytest.approx(0.1)


@pytest.mark.parametrize("pattern", ["{:012d}.png", "20260901123000{:03d}.png", "IMG_{}.png"])
def test_names_that_are_counts_or_dates_of_the_calendar_are_no_stamps(tmp_path: Path, pattern: str) -> None:
    for i, picture in enumerate(images(COUNT)):
        write_images(tmp_path / "s", [picture], pattern.format(i))
    assert open_sequence(tmp_path / "s", fov=60.0, fps=20.0).times[1] == pytest.approx(0.05)
    assert open_sequence(tmp_path / "s", fov=60.0).times[-1] < 1.0


@pytest.mark.parametrize(
    ("stamps", "unit"),
    [
        ([0.0, 0.033, 0.066], "seconds"),
        ([0.0, 1.0, 2.0], "seconds"),
        ([0, 33_333, 66_667], "microseconds"),
        ([0, 33_333_333, 66_666_667], "nanoseconds"),
        ([500, 1000, 1500], "milliseconds"),
        (np.rint(np.arange(100) * 1000 / 200), "milliseconds"),
        (np.rint(np.arange(100) * 1000 / 120), "milliseconds"),
        (np.rint(np.arange(100) * 1000 / 30), "milliseconds"),
        (np.rint(np.arange(100) * 1000 / 15), "milliseconds"),
        (np.arange(100) * 333.0, "milliseconds"),
        ([0, 2, 4, 6], "seconds"),
        ([0.001, 10, 20, 30], "seconds"),
        ([1.7e9, 1.7e9 + 1], "seconds"),
        ([1.7e18, 1.7e18 + 5e7], "nanoseconds"),
        ([np.nan], "seconds"),
        (np.arange(180) * 33_333_333.0, "nanoseconds"),  # their middle would be 2065 in seconds
        (1.2e9 + np.arange(300) * 33_333.0, "microseconds"),  # since 20 minutes before: 2008 in seconds
        (1.2e12 + np.arange(300) * 33_333_333.0, "nanoseconds"),  # likewise: 2008 in milliseconds
        (1.7e9 + np.arange(10) * 600.0, "seconds"),  # every ten minutes, with dates
    ],
)
def test_units_by_size(stamps: list[float], unit: str) -> None:
    assert unit_of(np.array(stamps, np.float64)) == unit


def test_milliseconds_from_0_are_read_as_such_and_a_note_tells_what_to_do_about_a_time_lapse(tmp_path: Path) -> None:
    path = folder(tmp_path / "s", "".join(f"{33 * i}\n" for i in range(COUNT)))
    (path / "groundtruth.txt").write_text(trajectory_text(0.033 * np.arange(COUNT), 1e3))
    sequence = open_sequence(path, fov=60.0)
    np.testing.assert_allclose(sequence.times, 0.033 * np.arange(COUNT))
    assert sequence.ground_truth is not None
    assert sequence.ground_truth.valid.all()
    assert any("taken as milliseconds" in note and "time lapse" in note for note in sequence.notes)
    assert open_sequence(path, fov=60.0, fps=0.1).times[1] == pytest.approx(10.0)


@pytest.mark.parametrize("stamps", [[0, 5, 10, 15], [0, 30, 60, 90]])
def test_places_and_counts_in_steps_are_no_milliseconds(stamps: list[int], tmp_path: Path) -> None:
    """A GPS receiver that writes every 5 s, and pictures of which every 30th was kept."""
    assert unit_of(np.array(stamps, np.float64), of_video=False) == "seconds"
    for number, picture in zip(stamps, images(4), strict=True):
        write_images(tmp_path / "s", [picture], f"{number:012d}.png")
    assert open_sequence(tmp_path / "s", fov=60.0, fps=20.0).times[1] == pytest.approx(0.05)
    assert not any("time stamps in" in note for note in open_sequence(tmp_path / "s", fov=60.0).notes)


@pytest.mark.parametrize(
    "text",
    [
        trajectory_text(TIMES, 1e9),
        "\ufeff" + trajectory_text(TIMES),
        "\ufeff# time tx ty tz qx qy qz qw\r\n" + trajectory_text(TIMES).replace("\n", "\r\n"),
        "timestamp tx ty tz qx qy qz qw\n" + trajectory_text(TIMES),
        trajectory_text(TIMES, point=","),
        trajectory_text(TIMES, separator=";", point=","),
        trajectory_text(TIMES, separator=", "),
        trajectory_text(TIMES, separator="\t"),
    ],
    ids=["ns", "bom", "bom-crlf", "names", "decimal-comma", "semicolon", "comma", "tab"],
)
def test_trajectories_of_any_program(tmp_path: Path, text: str) -> None:
    (tmp_path / "t.txt").write_bytes(text.encode())
    trajectory, _ = read_trajectory_report(tmp_path / "t.txt")
    np.testing.assert_allclose(trajectory.times, TIMES, rtol=0, atol=1e-6)
    np.testing.assert_allclose(trajectory.world_from_cam, poses(COUNT), rtol=0, atol=1e-9)


def test_the_names_of_the_columns_say_the_order_of_the_quaternion(tmp_path: Path) -> None:
    rows = [line.split(" ") for line in trajectory_text(TIMES, 1e9).splitlines()]
    w_first = [[*row[:4], row[7], *row[4:7]] for row in rows]
    for name, header, content in (
        ("a.csv", "#timestamp,p_x,p_y,p_z,q_x,q_y,q_z,q_w", rows),
        (
            "b.csv",
            "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []",
            w_first,
        ),
        ("c.csv", "time,x,y,z,qw,qx,qy,qz", w_first),
    ):
        (tmp_path / name).write_text("\n".join([header, *(",".join(row) for row in content)]))
        trajectory, _ = read_trajectory_report(tmp_path / name)
        np.testing.assert_allclose(trajectory.world_from_cam, poses(COUNT), rtol=0, atol=1e-9)


def test_lists_with_backslashes_and_decimal_commas(tmp_path: Path) -> None:
    write_images(tmp_path / "rgb", images(3), "{:05d}.png")
    (tmp_path / "rgb.txt").write_text("".join(f"0,{25 + i} .\\rgb\\{i:05d}.png\r\n" for i in range(3)))
    sequence = open_sequence(tmp_path, fov=60.0)
    np.testing.assert_allclose(sequence.times, [0.25, 0.26, 0.27])
    assert [Path(frame.source).name for frame in sequence] == [f"{i:05d}.png" for i in range(3)]
    assert not sequence.skipped


def test_no_stamps_and_as_many_true_poses(tmp_path: Path) -> None:
    path = folder(tmp_path / "s", trajectory_text(TIMES), "groundtruth.txt")
    sequence = open_sequence(path, fov=60.0)
    np.testing.assert_allclose(sequence.times, TIMES, atol=1e-6)
    assert any("row by row" in note for note in sequence.notes)
    truth = true_trajectory(path)  # needs no calibration
    assert truth is not None
    assert truth.valid.all()


def write_drive(day: Path, projection: np.ndarray, cam_from_imu: np.ndarray) -> Path:
    drive = day / "2011_09_26_drive_0001_sync"
    write_images(drive / "image_02" / "data", images(COUNT), "{:010d}.png")
    stamps = "".join(f"2011-09-26 13:02:{25 + 0.1 * i:09.6f}000\n" for i in range(COUNT))
    (drive / "image_02" / "timestamps.txt").write_text(stamps)
    (drive / "oxts" / "data").mkdir(parents=True)
    (drive / "oxts" / "timestamps.txt").write_text(stamps)
    for i in range(COUNT):
        row = [49.0, 8.4 + 1e-5 * i, 110.0 + i, 0.01 * i, 0.02, 0.3 + 0.1 * i, *([0.0] * 24)]
        (drive / "oxts" / "data" / f"{i:010d}.txt").write_text(" ".join(map(repr, row)))
    row = " ".join(map(repr, projection.ravel().tolist()))
    (day / "calib_cam_to_cam.txt").write_text(
        f"calib_time: 09-Jan-2012\nS_02: 100 80\nK_02: 80 0 50 0 80 40 0 0 1\nD_02: -0.3 0.1 0 0 0\nS_rect_02: 96 72\n"
        f"R_rect_00: 1 0 0 0 1 0 0 0 1\nP_rect_02: {row}\n"
    )
    for name, motion in (("velo_to_cam", cam_from_imu), ("imu_to_velo", np.eye(4))):
        turn, place = (" ".join(map(repr, part.ravel().tolist())) for part in (motion[:3, :3], motion[:3, 3]))
        (day / f"calib_{name}.txt").write_text(f"R: {turn}\nT: {place}\n")
    return drive


def test_kitti_raw_drive(tmp_path: Path) -> None:
    projection = np.array([[90.0, 0, 47, 9], [0, 91, 36.5, 0], [0, 0, 1, 0]])
    cam_from_imu = rigid(so3_exp(np.array([0.3, -1.2, 0.4])), np.array([0.1, 0.2, -0.3]))
    drive = write_drive(tmp_path / "2011_09_26", projection, cam_from_imu)
    sequence = open_sequence(drive)
    assert sequence.format == "kitti-raw"
    assert (sequence.camera.fx, sequence.camera.fy, sequence.camera.cx, sequence.camera.cy) == (90, 91, 47, 36.5)
    np.testing.assert_allclose(np.diff(sequence.times), 0.1, atol=1e-6)
    truth = sequence.ground_truth
    assert truth is not None
    # the fixed motion from camera to inertial unit: the first camera, seen from the first inertial unit
    world_from_imu = so3_exp(np.array([[0.0, 0, 0.3]]))[0] @ so3_exp(np.array([[0, 0.02, 0]]))[0]
    shift = rigid(np.eye(3), np.array([0.1, 0, 0]))
    expected = rigid(world_from_imu, np.zeros(3)) @ inverse(shift @ cam_from_imu)
    np.testing.assert_allclose(truth.world_from_cam[0], expected, atol=1e-9)
    step = np.cos(np.radians(49)) * np.radians(1e-5) * 6378137
    moved = truth.world_from_cam[1] @ shift @ cam_from_imu
    np.testing.assert_allclose(moved[:3, 3], [step, 0, 1], atol=1e-6)
    with pytest.raises(InputError, match="--topic can be image_02"):
        open_sequence(drive, topic="image_05")


def test_pictures_of_an_extracted_drive_have_the_poses_of_the_camera_as_it_was_built_in(tmp_path: Path) -> None:
    cam_from_cam0 = rigid(so3_exp(np.array([0.01, 0.02, -0.015])), np.array([0.06, 0.001, 0.002]))
    cam_from_imu = rigid(so3_exp(np.array([0.3, -1.2, 0.4])), np.array([0.1, 0.2, -0.3]))
    day = tmp_path / "2011_09_26"
    drive = write_drive(day, np.array([[90.0, 0, 47, 9], [0, 91, 36.5, 0], [0, 0, 1, 0]]), cam_from_imu)
    turn, place = (" ".join(map(repr, part.ravel().tolist())) for part in (cam_from_cam0[:3, :3], cam_from_cam0[:3, 3]))
    calibration = day / "calib_cam_to_cam.txt"
    rectified = open_sequence(drive).ground_truth
    assert rectified is not None
    # the other way round: 96x72 is now the size of the pictures that are not rectified
    text = calibration.read_text().replace("S_rect_02: 96 72", "S_rect_02: 90 70").replace("S_02: 100", "S_02: 96")
    text = text.replace("S_02: 96 80", "S_02: 96 72")
    calibration.write_text(f"{text}R_02: {turn}\nT_02: {place}\n")
    sequence = open_sequence(drive)
    assert sequence.raw_camera.distortion[:2] == (-0.3, 0.1)
    truth = sequence.ground_truth
    assert truth is not None
    shift = rigid(np.eye(3), np.array([0.1, 0, 0]))
    np.testing.assert_allclose(
        truth.world_from_cam @ cam_from_cam0, rectified.world_from_cam @ shift, rtol=0, atol=1e-9
    )


def test_a_damaged_first_row_of_the_inertial_unit_costs_that_pose_alone(tmp_path: Path) -> None:
    drive = write_drive(tmp_path / "day", np.array([[90.0, 0, 47, 0], [0, 91, 36.5, 0], [0, 0, 1, 0]]), np.eye(4))
    whole = open_sequence(drive).ground_truth
    assert whole is not None
    (drive / "oxts" / "data" / f"{0:010d}.txt").write_text("")
    truth = open_sequence(drive).ground_truth
    assert truth is not None
    assert truth.valid.tolist() == [False, *[True] * (COUNT - 1)]
    # positions count from the first place that is known
    moved = whole.camera_centers[1:] - whole.camera_centers[1]
    np.testing.assert_allclose(truth.camera_centers[1:] - truth.camera_centers[1], moved, rtol=0, atol=1e-6)


def test_true_poses_without_times_follow_the_pictures_at_any_rate(tmp_path: Path) -> None:
    path = folder(tmp_path / "s", "".join(f"{0.1 * i}\n" for i in range(COUNT)))
    np.savetxt(path / "groundtruth.txt", poses(COUNT)[:, :3].reshape(COUNT, 12))
    for settings in ({}, {"fps": 20.0}):
        sequence = open_sequence(path, fov=60.0, **settings)
        np.testing.assert_allclose(sequence.times, np.arange(COUNT) * (0.05 if settings else 0.1))
        assert sequence.ground_truth is not None
        np.testing.assert_allclose(sequence.ground_truth.world_from_cam, poses(COUNT), rtol=0, atol=1e-9)
