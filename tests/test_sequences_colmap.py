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


@pytest.mark.parametrize("damage", ["two cameras", "cut short"])
def test_a_model_that_cannot_be_used_leaves_a_folder_of_images(project: Path, damage: str) -> None:
    model = project / "sparse" / "0"
    if damage == "two cameras":
        first = (model / "cameras.txt").read_text()
        (model / "cameras.txt").write_text(
            first + first.replace("3 PINHOLE", "4 SIMPLE_PINHOLE", 1).replace(" 91.0", "")
        )
        (model / "images.txt").write_text((model / "images.txt").read_text().replace(" 3 0003.png", " 4 0003.png"))
    else:
        (model / "images.txt").write_text("1 1 0 0\n")
    with pytest.raises(InputError, match="has no calibration"):
        open_sequence(project)
    sequence = open_sequence(project, fov=60.0)
    assert sequence.ground_truth is None
    assert any("its COLMAP model is left out" in note for note in sequence.notes)


def test_a_folder_without_a_model_is_refused_by_name(tmp_path: Path) -> None:
    write_images(tmp_path, images(2))
    with pytest.raises(InputError, match="has no COLMAP model in sparse/0, sparse, "):
        open_sequence(tmp_path, format="colmap")
