"""What is wrong with a recording is said in one line that names the file and the mend, or skipped and counted."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from improvo.errors import ConfigError, ImprovoError, InputError
from improvo.geometry.camera_files import calibration_yaml
from improvo.sequences import open_sequence
from improvo.types import Trajectory
from sequence_builders import CAMERA, images, poses, write_images, write_tum


def folder_of_images(folder: Path, count: int = 9, pattern: str = "{:06d}.png") -> Path:
    write_images(folder, images(count), pattern)
    (folder / "camera.yaml").write_text(calibration_yaml(CAMERA, fps=30.0))
    return folder


def refused(path: Path, **settings: object) -> str:
    with pytest.raises(ImprovoError) as error:
        open_sequence(path, **settings)
    message = str(error.value)
    assert "\n" not in message
    return message


def test_no_such_path(tmp_path: Path) -> None:
    assert refused(tmp_path / "none") == f"{tmp_path / 'none'}: no such file or folder; check the path"


def test_empty_folder(tmp_path: Path) -> None:
    assert "the folder is empty" in refused(tmp_path)


def test_unknown_layout_lists_what_is_known(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("hello")
    for path in (tmp_path, tmp_path / "notes.txt"):
        message = refused(path)
        assert str(path) in message
        assert "tum" in message
        assert "--format" in message


def test_unknown_format_and_setting(tmp_path: Path) -> None:
    folder_of_images(tmp_path)
    with pytest.raises(ConfigError, match="--format euroq: unknown"):
        open_sequence(tmp_path, format="euroq")
    with pytest.raises(ConfigError, match="unknown sequence setting strides"):
        open_sequence(tmp_path, strides=2)


@pytest.mark.parametrize("format", ["7scenes", "tum", "kitti", "video"])
def test_a_format_that_it_is_not(tmp_path: Path, format: str) -> None:
    assert str(tmp_path) in refused(folder_of_images(tmp_path), format=format)


def test_no_calibration_offers_camera_and_fov(tmp_path: Path) -> None:
    write_images(tmp_path, images(3))
    message = refused(tmp_path)
    assert str(tmp_path) in message
    assert "--camera" in message
    assert "--fov" in message


def test_calibration_for_another_size_says_both(tmp_path: Path) -> None:
    folder_of_images(tmp_path)
    (tmp_path / "camera.yaml").write_text(calibration_yaml(CAMERA.resized(192, 144)))
    message = refused(tmp_path)
    assert "192x144" in message
    assert "96x72" in message
    assert "--camera" in message


@pytest.mark.parametrize("damage", ["empty", "text", "cut", "size"])
@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_one_unreadable_frame_is_skipped_counted_and_named(tmp_path: Path, damage: str, suffix: str) -> None:
    folder_of_images(tmp_path, pattern="{:06d}." + suffix)
    file = tmp_path / f"000004.{suffix}"
    if damage == "size":
        cv2.imwrite(str(file), np.zeros((10, 12), np.uint8))
    else:
        data = file.read_bytes()
        file.write_bytes({"empty": b"", "text": b"not an image", "cut": data[: 2 * len(data) // 3]}[damage])
    sequence = open_sequence(tmp_path)
    assert [frame.source_index for frame in sequence] == [0, 1, 2, 3, 5, 6, 7, 8]
    assert [frame.source_index for frame in sequence] == [0, 1, 2, 3, 5, 6, 7, 8]  # a second pass counts it once
    assert [(skip.index, skip.source) for skip in sequence.skipped] == [(4, str(file))]
    assert sequence.skipped[0].reason
    assert sequence[5].time == pytest.approx(5 / 30)
    with pytest.raises(InputError, match="000004"):
        sequence[4]
    with pytest.raises(IndexError):
        sequence[9]


def test_the_first_frame_may_be_unreadable_but_not_all(tmp_path: Path) -> None:
    folder_of_images(tmp_path, 3)
    (tmp_path / "000000.png").write_bytes(b"")
    assert [frame.source_index for frame in open_sequence(tmp_path)] == [1, 2]
    for file in tmp_path.glob("*.png"):
        file.write_bytes(b"x")
    assert "none of the first frames can be read" in refused(tmp_path)


def test_images_cut_at_any_byte(tmp_path: Path) -> None:
    for suffix in ("png", "jpg"):
        folder = folder_of_images(tmp_path / suffix, 3, "{:06d}." + suffix)
        data = (folder / f"000001.{suffix}").read_bytes()
        for length in range(0, len(data) - 2, max(1, len(data) // 25)):
            (folder / f"000001.{suffix}").write_bytes(data[:length])
            sequence = open_sequence(folder)
            assert [frame.source_index for frame in sequence] == [0, 2], length


def test_bad_ground_truth_is_counted_and_named(tmp_path: Path) -> None:
    write_tum(tmp_path)
    file = tmp_path / "groundtruth.txt"
    lines = file.read_text().splitlines()
    lines[2] = lines[2].split()[0] + " nan 0 0 0 0 0 1"
    lines[4] = lines[4].split()[0] + " 0 0 0 0 0 0 3"
    file.write_text("\n".join(lines))
    sequence = open_sequence(tmp_path)
    truth = sequence.ground_truth
    assert isinstance(truth, Trajectory)
    assert len(truth) == len(sequence)
    # rows 1 and 3 lie between good neighbours less than 0.1 s apart, which are interpolated
    np.testing.assert_allclose(truth.world_from_cam[[0, 2, 4]], poses(7)[[0, 2, 4]], atol=1e-9)
    notes = "\n".join(sequence.notes)
    assert "NaN or infinite (line 3)" in notes
    assert "not a rigid motion (line 5)" in notes
    assert "groundtruth.txt" in notes


def test_ground_truth_without_any_pose_is_an_error(tmp_path: Path) -> None:
    write_tum(tmp_path)
    (tmp_path / "groundtruth.txt").write_text("0 nan 0 0 0 0 0 1\n")
    message = refused(tmp_path)
    assert "groundtruth.txt" in message
    assert "remove" in message


def test_seven_scenes_with_bad_poses(tmp_path: Path) -> None:
    for i, image in enumerate(images(4)):
        cv2.imwrite(str(tmp_path / f"frame-{i:06d}.color.png"), image)
        np.savetxt(tmp_path / f"frame-{i:06d}.pose.txt", poses(4)[i])
    (tmp_path / "camera.yaml").write_text(calibration_yaml(CAMERA))
    (tmp_path / "frame-000001.pose.txt").write_text("1 2 3")
    (tmp_path / "frame-000002.pose.txt").write_text(("-1.#IND " * 4 + "\n") * 4)
    sequence = open_sequence(tmp_path, fps=1.0)
    assert sequence.ground_truth is not None
    assert sequence.ground_truth.valid.tolist() == [True, False, False, True]
    assert any("2 pose files hold no rigid pose" in n and "frame-000001.pose.txt" in n for n in sequence.notes)
    for i in (0, 3):
        (tmp_path / f"frame-{i:06d}.pose.txt").write_text("nan " * 16)
    assert "none of the 4 pose files" in refused(tmp_path)


def test_unsorted_and_repeated_time_stamps(tmp_path: Path) -> None:
    write_tum(tmp_path)
    lines = (tmp_path / "rgb.txt").read_text().splitlines()
    repeated = lines[3].split()[0] + " rgb/000005.png"
    (tmp_path / "rgb.txt").write_text("\n".join([lines[6], *lines[:6], repeated, "garbage", lines[7]]))
    sequence = open_sequence(tmp_path)
    assert (np.diff(sequence.times) > 0).all()
    assert all((frame.image == image).all() for frame, image in zip(sequence, images(7), strict=True))
    notes = "\n".join(sequence.notes)
    assert "1 rows repeat a time stamp" in notes
    assert "1 rows are not `timestamp filename`" in notes


def test_times_that_do_not_fit_the_images(tmp_path: Path) -> None:
    folder_of_images(tmp_path, 3)
    for content, reason in (("0\n1\n", "2 times for 3 images"), ("0\nx\n2\n", "one time in seconds per line")):
        (tmp_path / "times.txt").write_text(content)
        message = refused(tmp_path)
        assert "times.txt" in message
        assert reason in message
        assert len(open_sequence(tmp_path, fps=10.0)) == 3


def test_kitti_without_its_camera_row(tmp_path: Path) -> None:
    write_images(tmp_path / "image_0", images(3))
    (tmp_path / "calib.txt").write_text("P1: 1 2 3\n")
    message = refused(tmp_path)
    assert "calib.txt" in message
    assert "P0" in message


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"stride": 0}, "stride"),
        ({"max_frames": 0}, "max_frames"),
        ({"start": 100}, "none of them"),
        ({"start": -1}, "negative"),
        ({"start": 3, "end": 3}, "none of them"),
        ({"width": 2}, "width"),
        ({"fps": 0.0}, "fps"),
        ({"fov": 200.0}, "--fov"),
        ({"camera": "nowhere.yaml"}, "--camera nowhere.yaml"),
    ],
)
def test_impossible_settings(tmp_path: Path, settings: dict[str, object], reason: str) -> None:
    assert reason in refused(folder_of_images(tmp_path), **settings)


def test_depth_that_cannot_be_read_is_no_depth(tmp_path: Path) -> None:
    write_tum(tmp_path)
    (tmp_path / "depth" / "000002.png").write_bytes(b"x")
    cv2.imwrite(str(tmp_path / "depth" / "000003.png"), np.ones((4, 4), np.uint16))
    sequence = open_sequence(tmp_path)
    assert [sequence.depth(i) is None for i in range(5)] == [False, False, True, True, False]
