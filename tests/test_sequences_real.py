"""The real sequences open as they are, with the traps that their README names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from improvo.sequences import open_sequence


@pytest.mark.parametrize(
    ("name", "format", "frames", "with_truth", "with_depth", "step"),
    [
        ("redkitchen", "7scenes", 600, 600, 300, 1 / 30),
        ("hololens-office", "tum", 186, 186, 186, 1 / 3),
        ("checkerboard-desk", "images", 300, 300, 0, 1 / 30),
        ("kitti00", "kitti", 100, 100, 0, 0.1),
        ("fr3-notexture", "tum", 100, 96, 97, 1 / 30),
        ("icsl-corridor", "images", 220, 0, 0, 1 / 30),
    ],
)
def test_opens_by_its_path_alone(
    shared_data: Path, name: str, format: str, frames: int, with_truth: int, with_depth: int, step: float
) -> None:
    sequence = open_sequence(shared_data / name)
    assert (sequence.format, len(sequence)) == (format, frames)
    assert np.median(np.diff(sequence.times)) == pytest.approx(step, rel=0.1)
    truth = sequence.ground_truth
    assert (0 if truth is None else int(truth.valid.sum())) == with_truth
    if truth is not None:
        rotation = truth.world_from_cam[truth.valid, :3, :3]
        np.testing.assert_allclose(
            np.swapaxes(rotation, 1, 2) @ rotation, np.tile(np.eye(3), (with_truth, 1, 1)), atol=1e-12
        )
    size = (sequence.camera.height, sequence.camera.width)
    assert sequence[frames // 2].image.shape == size
    found = [sequence.depth(i) for i in range(10)]
    expected = with_depth / frames
    assert sum(depth is not None for depth in found) == pytest.approx(10 * expected, abs=1.01)
    for depth in found:
        if depth is not None:
            assert depth.shape == size
            assert 0.3 < np.nanmedian(depth) < 8.0


def test_checkerboard_is_undistorted_to_the_widest_view(shared_data: Path) -> None:
    sequence = open_sequence(shared_data / "checkerboard-desk", max_frames=1)
    assert sequence.raw_camera.distortion
    assert sequence.camera.is_pinhole
    assert sequence.camera.fx / sequence.raw_camera.fx == pytest.approx(sequence.camera.fy / sequence.raw_camera.fy)
    assert "undistorted" in sequence.view


def test_training_pictures_have_truth_by_frame_number(shared_data: Path) -> None:
    folder = shared_data.parent / "training" / "icl-office-kt0-a"
    if not folder.is_dir():
        pytest.skip("needs the training pictures in ../shared/training")
    sequence = open_sequence(folder)
    assert sequence.ground_truth is not None
    first = np.flatnonzero(sequence.ground_truth.valid)[0]
    assert first == 1  # the file starts at t = 0.033333, which is frame 1
    np.testing.assert_allclose(sequence.ground_truth.camera_centers[1], [0.0004725, -0.0089707, -2.5])
