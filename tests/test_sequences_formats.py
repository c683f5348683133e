"""Each format gives back what was written: pixels, times, poses, depth, calibration."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from improvo.errors import InputError
from improvo.geometry.camera_files import calibration_yaml
from improvo.geometry.se3 import inverse, rigid
from improvo.sequences import SequenceSettings, open_recording, open_sequence
from improvo.simulation.tum_writer import TumRgbdWriter
from improvo.types import Trajectory
from sequence_builders import CAMERA, depths, images, poses, write_images, write_tum

COUNT = 7


def test_tum_round_trip_is_exact(tmp_path: Path) -> None:
    times = write_tum(tmp_path / "tum")
    sequence = open_sequence(tmp_path / "tum")
    assert (sequence.format, sequence.name, len(sequence)) == ("tum", "tum", COUNT)
    assert sequence.camera == CAMERA
    np.testing.assert_allclose(sequence.times, times, atol=1e-6)
    for i, (frame, image, depth) in enumerate(zip(sequence, images(COUNT), depths(COUNT), strict=True)):
        assert (frame.image == image).all()
        assert frame.source_index == i
        assert frame.time == sequence.times[i]
        np.testing.assert_array_equal(sequence.depth(i), depth)
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.world_from_cam, poses(COUNT), atol=1e-9)


def test_tum_associates_depth_and_truth_by_time(tmp_path: Path) -> None:
    write_tum(tmp_path)
    rows = (tmp_path / "depth.txt").read_text().splitlines()[1:]
    shifted = [f"{float(row.split()[0]) + 0.01:.6f} {row.split()[1]}" for row in rows if "000003" not in row]
    (tmp_path / "depth.txt").write_text("\n".join(shifted))
    truth = (tmp_path / "groundtruth.txt").read_text().splitlines()
    (tmp_path / "groundtruth.txt").write_text("\n".join(truth[:4]))
    sequence = open_sequence(tmp_path)
    assert [sequence.depth(i) is None for i in range(COUNT)] == [False] * 3 + [True] + [False] * 3
    np.testing.assert_array_equal(sequence.depth(4), depths(COUNT)[4])
    assert sequence.ground_truth is not None
    assert sequence.ground_truth.valid.tolist() == [True] * 3 + [False] * 4
    assert any("depth for 6 of 7 images" in note for note in sequence.notes)


@pytest.mark.parametrize("swapped", [False, True])
def test_tum_with_an_association_file(tmp_path: Path, swapped: bool) -> None:
    write_tum(tmp_path)
    lists = [(tmp_path / name).read_text().splitlines()[1:] for name in ("rgb.txt", "depth.txt")]
    rows = [f"{b} {a}" if swapped else f"{a} {b}" for a, b in zip(*lists, strict=True)]
    (tmp_path / "associations.txt").write_text("\n".join(rows))
    (tmp_path / "rgb.txt").unlink()
    (tmp_path / "depth.txt").unlink()
    sequence = open_sequence(tmp_path)
    assert (sequence.format, len(sequence)) == ("tum", COUNT)
    assert (sequence[3].image == images(COUNT)[3]).all()
    np.testing.assert_array_equal(sequence.depth(3), depths(COUNT)[3])


def test_truth_between_stamps_is_interpolated(tmp_path: Path) -> None:
    write_images(tmp_path, images(3))
    (tmp_path / "camera.yaml").write_text(calibration_yaml(CAMERA))
    (tmp_path / "times.txt").write_text("0.5\n0.525\n0.55\n")
    (tmp_path / "groundtruth.txt").write_text(
        "0.5 0 0 0 0 0 0 1\n0.55 1 0 0 0 0 0.19866933079506122 0.9800665778412416\n"
    )
    truth = open_sequence(tmp_path).ground_truth
    assert isinstance(truth, Trajectory)
    np.testing.assert_allclose(truth.camera_centers[:, 0], [0, 0.5, 1], atol=1e-9)
    np.testing.assert_allclose(np.arctan2(truth.world_from_cam[:, 1, 0], truth.world_from_cam[:, 0, 0]), [0, 0.2, 0.4])


def test_seven_scenes(tmp_path: Path) -> None:
    for i, (image, depth, pose) in enumerate(zip(images(COUNT), depths(COUNT), poses(COUNT), strict=True)):
        cv2.imwrite(str(tmp_path / f"frame-{i:06d}.color.png"), cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
        values = np.nan_to_num(np.rint(depth * 1000), nan=65535).astype(np.uint16)
        if i % 2 == 0:
            cv2.imwrite(str(tmp_path / f"frame-{i:06d}.depth.png"), values)
        pose = pose.copy()
        pose[:3, :3] *= 1 + 3e-4  # as orthonormal as the data set's own
        np.savetxt(tmp_path / f"frame-{i:06d}.pose.txt", pose)
    (tmp_path / "camera.yaml").write_text(calibration_yaml(CAMERA, fps=20.0))
    sequence = open_sequence(tmp_path)
    assert sequence.format == "7scenes"
    np.testing.assert_allclose(sequence.times, np.arange(COUNT) / 20)
    assert all((frame.image == image).all() for frame, image in zip(sequence, images(COUNT), strict=True))
    np.testing.assert_array_equal(sequence.depth(2), depths(COUNT)[2])
    assert sequence.depth(1) is None
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.world_from_cam, poses(COUNT), atol=1e-9)


def test_seven_scenes_pictures_of_one_number_are_chosen_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("frame-000000.color.jpg", "frame-000000.color.png", "frame-000001.color.png"):
        write_images(tmp_path, images(1), name)
    listed = list(tmp_path.iterdir())
    for order in (sorted(listed), sorted(listed, reverse=True)):  # a file system lists files in any order
        monkeypatch.setattr(Path, "iterdir", lambda self, order=order: iter(order))
        recording = open_recording(tmp_path)
        assert [Path(recording.source(row)).suffix for row in range(2)] == [".png", ".png"]


@pytest.mark.parametrize("number", [0, 2])
def test_kitti_uses_the_projection_of_its_camera(tmp_path: Path, number: int) -> None:
    folder = tmp_path / "sequences" / "04"
    write_images(folder / f"image_{number}", images(COUNT))
    offset = np.array([0.06 if number else 0.0, 0.001 if number else 0.0, 0.0])
    cam_from_cam0 = rigid(np.eye(3), offset)
    projection = CAMERA.K @ cam_from_cam0[:3]
    rows = {f"P{n}": projection if n == number else np.zeros((3, 4)) for n in range(4)}
    text = "".join(f"{name}: {' '.join(f'{v:.17e}' for v in value.ravel())}\n" for name, value in rows.items())
    (folder / "calib.txt").write_text(text)
    times = np.arange(COUNT) * 0.1037
    (folder / "times.txt").write_text("".join(f"{t:.6e}\n" for t in times))
    (tmp_path / "poses").mkdir()
    np.savetxt(tmp_path / "poses" / "04.txt", poses(COUNT)[:, :3].reshape(COUNT, 12))
    sequence = open_sequence(folder)
    assert sequence.format == "kitti"
    np.testing.assert_allclose(sequence.camera.K, CAMERA.K, atol=1e-9)
    np.testing.assert_allclose(sequence.times, times, atol=1e-6)
    assert all((frame.image == image).all() for frame, image in zip(sequence, images(COUNT), strict=True))
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.world_from_cam, poses(COUNT) @ inverse(cam_from_cam0), atol=1e-9)


@pytest.mark.parametrize("timed", [True, False])
def test_kitti_pictures_that_are_missing_shift_no_other(tmp_path: Path, timed: bool) -> None:
    pictures, there = images(COUNT), [1, 2, *range(4, COUNT)]
    for number in there:
        write_images(tmp_path / "image_0", [pictures[number]], f"{number:06d}.png")
    np.savetxt(tmp_path / "calib.txt", [(CAMERA.K @ np.eye(4)[:3]).ravel()])
    np.savetxt(tmp_path / "poses.txt", poses(COUNT)[:, :3].reshape(COUNT, 12))
    step = 0.25 if timed else 0.1
    if timed:
        (tmp_path / "times.txt").write_text("".join(f"{step * i}\n" for i in range(COUNT)))
    sequence = open_sequence(tmp_path)
    np.testing.assert_allclose(sequence.times, step * np.array(there))
    assert all((frame.image == pictures[number]).all() for frame, number in zip(sequence, there, strict=True))
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.world_from_cam, poses(COUNT)[there], atol=1e-9)
    assert sequence.notes == ((f"{tmp_path}: 2 of {COUNT} images are missing",) if timed else ())


@pytest.mark.parametrize("folder", ["image_l", "image_r", "image_0"])
def test_kitti_copies_of_courses_name_no_camera_in_their_calibration(tmp_path: Path, folder: str) -> None:
    write_images(tmp_path / folder, images(COUNT))
    cam_from_cam0 = rigid(np.eye(3), np.array([-0.54, 0.0, 0.0]))
    projections = [CAMERA.K @ np.eye(4)[:3], CAMERA.K @ cam_from_cam0[:3]]
    np.savetxt(tmp_path / "calib.txt", [projection.ravel() for projection in projections])
    np.savetxt(tmp_path / "poses.txt", poses(COUNT)[:, :3].reshape(COUNT, 12))
    sequence = open_sequence(tmp_path)
    assert sequence.format == "kitti"
    np.testing.assert_allclose(sequence.camera.K, CAMERA.K, atol=1e-9)
    np.testing.assert_allclose(sequence.times, np.arange(COUNT) / 10)
    expected = poses(COUNT) @ inverse(cam_from_cam0) if folder == "image_r" else poses(COUNT)
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.world_from_cam, expected, atol=1e-9)


def test_a_folder_of_recordings_is_told_with_what_it_holds(tmp_path: Path) -> None:
    for name in ("walk", "drive"):
        write_images(tmp_path / name / "left", images(2))
    (tmp_path / "notes.txt").write_text("both from Monday")
    with pytest.raises(InputError, match=r"is no recording itself but holds drive, walk; give one of these"):
        open_sequence(tmp_path)
    (tmp_path / "walk" / "left").rename(tmp_path / "walk" / "mine")
    with pytest.raises(InputError, match=r"walk: is no recording itself but holds mine; give that"):
        open_sequence(tmp_path / "walk")


def test_image_folder_orders_by_number_and_keeps_gaps_in_time(tmp_path: Path) -> None:
    pictures = images(12)
    for number, picture in enumerate(pictures):
        if number != 5:
            cv2.imwrite(str(tmp_path / f"view{number}.png"), picture)
    (tmp_path / "camera.yaml").write_text(calibration_yaml(CAMERA, fps=10.0))
    sequence = open_sequence(tmp_path)
    kept = [i for i in range(12) if i != 5]
    np.testing.assert_allclose(sequence.times, np.array(kept) / 10)
    assert all((frame.image == pictures[i]).all() for frame, i in zip(sequence, kept, strict=True))


def test_image_folder_may_be_named_by_its_inside(tmp_path: Path) -> None:
    write_images(tmp_path / "images", images(3))
    (tmp_path / "camera.yaml").write_text(calibration_yaml(CAMERA, fps=5.0))
    for path in (tmp_path, tmp_path / "images"):
        sequence = open_sequence(path)
        assert sequence.camera == CAMERA
        np.testing.assert_allclose(sequence.times, [0, 0.2, 0.4])


def test_selection_keeps_recording_indices_and_times(tmp_path: Path) -> None:
    times = write_tum(tmp_path)
    sequence = open_sequence(tmp_path, SequenceSettings(start=1, end=6, stride=2), max_frames=2)
    assert [frame.source_index for frame in sequence] == [1, 3]
    np.testing.assert_allclose(sequence.times, times[[1, 3]], atol=1e-6)
    assert (sequence[1].image == images(COUNT)[3]).all()
    np.testing.assert_array_equal(sequence.depth(1), depths(COUNT)[3])
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.camera_centers, poses(COUNT)[[1, 3], :3, 3], atol=1e-9)
    assert [sequence.row(frame) for frame in sequence] == [0, 1]


def test_a_recording_opens_without_a_calibration(tmp_path: Path) -> None:
    write_images(tmp_path, images(3))
    recording = open_recording(tmp_path)
    assert recording.calibration is None
    assert (recording.image(2) == images(3)[2]).all()


def test_a_writer_that_is_killed_leaves_no_lists_of_an_earlier_recording(tmp_path: Path) -> None:
    """They would name pictures of both."""
    with TumRgbdWriter(tmp_path, CAMERA) as writer:
        for i, image in enumerate(images(COUNT)):
            writer.add(i / 10, image, depths(COUNT)[i], poses(COUNT)[i])
    killed = TumRgbdWriter(tmp_path, CAMERA)
    killed.add(0.0, 255 - images(COUNT)[0])
    assert not {"rgb.txt", "depth.txt", "groundtruth.txt"} & {path.name for path in tmp_path.iterdir()}
    killed.close()
    sequence = open_sequence(tmp_path)
    assert len(sequence) == 1
    assert sequence.ground_truth is None
    assert sequence.depth(0) is None


def test_an_interrupted_writer_leaves_a_valid_shorter_sequence(tmp_path: Path) -> None:
    def interrupted() -> None:
        with TumRgbdWriter(tmp_path, CAMERA) as writer:
            for i, image in enumerate(images(COUNT)):
                if i == 4:
                    raise KeyboardInterrupt
                writer.add(i / 10, image)

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert len(list(open_sequence(tmp_path))) == 4
    assert not [file for file in tmp_path.rglob("*") if "partial" in file.name]
