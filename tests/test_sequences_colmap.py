"""A COLMAP project as a recording: what its model gives, and what is left where it gives nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import sequence_encoders as encoders
from improvo.errors import InputError
from improvo.sequences import open_sequence
from improvo.sequences.opening import true_trajectory
from sequence_builders import CAMERA, images, poses, write_images
from sequence_encoders import Scene

COUNT = 6


@pytest.fixture
def project(tmp_path: Path) -> Path:
    scene = Scene(CAMERA, np.arange(COUNT) / 30, images(COUNT), np.ones((COUNT, 72, 96)), poses(COUNT))
    return encoders.write_colmap_project(tmp_path / "project", scene)


def without_images(project: Path, *missing: int) -> None:
    """The model registered all images but these."""
    file = project / "sparse" / "0" / "images.txt"
    lines = file.read_text().splitlines()
    rows = [line for line in lines[::2] if int(line.split()[0]) - 1 not in missing]
    file.write_text("".join(f"{row}\n\n" for row in rows))


def test_an_image_that_the_model_lacks_stays_without_a_pose(project: Path) -> None:
    without_images(project, 2)
    sequence = open_sequence(project)
    assert len(sequence) == COUNT
    truth = sequence.ground_truth
    assert truth is not None
    assert truth.valid.tolist() == [True, True, False, True, True, True]
    np.testing.assert_allclose(truth.world_from_cam[3], poses(COUNT)[3], atol=1e-9)
    assert any("true poses of 5 of 6 images" in note for note in sequence.notes)
    half = true_trajectory(project, stride=2)
    assert half is not None
    assert half.valid.tolist() == [True, False, True]


def test_its_images_folder_is_the_same_recording(project: Path) -> None:
    sequence = open_sequence(project / "images")
    assert (sequence.format, sequence.camera) == ("colmap", CAMERA)
    assert sequence.ground_truth is not None


def test_what_lies_beside_the_images_comes_before_the_model(project: Path) -> None:
    (project / "camera.txt").write_text("80 80 40 30\n")
    (project / "groundtruth.txt").write_text("".join(f"{i / 30} {i} 0 0 0 0 0 1\n" for i in range(COUNT)))
    sequence = open_sequence(project)
    assert sequence.camera.fx == 80
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.camera_centers[:, 0], np.arange(COUNT), atol=1e-9)


def with_second_camera(project: Path, row: str) -> Path:
    """The fourth image has this camera."""
    model = project / "sparse" / "0"
    (model / "cameras.txt").write_text(f"3 PINHOLE 96 72 90 91 47.5 37\n4 {row}\n")
    (model / "images.txt").write_text((model / "images.txt").read_text().replace(" 3 0003.png", " 4 0003.png"))
    return project


def test_where_each_image_has_its_own_camera_their_median_is_taken(project: Path) -> None:
    sequence = open_sequence(with_second_camera(project, "PINHOLE 96 72 99 91 47.5 37"))
    assert sequence.camera == CAMERA
    assert any("intrinsics vary by 10.0 % of the focal length" in note for note in sequence.notes)


def test_images_of_two_kinds_of_camera_want_one_that_is_given(project: Path) -> None:
    with_second_camera(project, "SIMPLE_RADIAL 96 72 90 47.5 37 0.1")
    with pytest.raises(InputError, match="its images have 2 different cameras"):
        open_sequence(project)
    sequence = open_sequence(project, fov=60.0)
    assert sequence.ground_truth is not None
    assert sequence.ground_truth.valid.all()


def test_a_damaged_model_leaves_a_folder_of_images(project: Path) -> None:
    (project / "sparse" / "0" / "images.txt").write_text("1 1 0 0\n")
    with pytest.raises(InputError, match="has no calibration"):
        open_sequence(project)
    sequence = open_sequence(project, fov=60.0)
    assert sequence.ground_truth is None
    assert any("its COLMAP model is left out" in note for note in sequence.notes)


def test_a_folder_without_a_model_is_refused_by_name(tmp_path: Path) -> None:
    write_images(tmp_path, images(2))
    with pytest.raises(InputError, match="has no COLMAP model in sparse/0, sparse, "):
        open_sequence(tmp_path, format="colmap")
