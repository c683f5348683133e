"""What is read back of a label store, and how a store that is none or was changed is refused."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from improvo.errors import InputError
from improvo.labeling.labeled import read_labels
from labeled_scene import CAMERA, FRAMES, camera_x, write_labeled_scene


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Not to be written to."""
    return write_labeled_scene(tmp_path_factory.mktemp("store") / "labels")


@pytest.fixture
def store(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "labels"))


def test_camera_poses_and_pictures_are_those_that_were_written(whole: Path) -> None:
    (one,) = read_labels(whole)
    assert (one.name, len(one.frames), one.camera) == ("walls", FRAMES, CAMERA)
    centres = [-camera_x(frame) for frame in range(FRAMES)]  # of a camera that does not turn
    np.testing.assert_allclose(one.cam_from_world[:, 0, 3], centres, atol=1e-6)
    np.testing.assert_allclose(one.cam_from_world[:, :3, :3], np.tile(np.eye(3), (FRAMES, 1, 1)), atol=1e-6)
    assert one.image(0).shape == (CAMERA.height, CAMERA.width)
    assert one.tracks.track.max() < len(one.points)


def test_a_folder_that_is_no_store_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        read_labels(tmp_path / "nowhere")
    with pytest.raises(InputError, match="is no label store"):
        read_labels(tmp_path)


def test_a_store_without_a_finished_sequence_is_refused(store: Path) -> None:
    shutil.rmtree(store / "walls")
    with pytest.raises(InputError, match="has no labelled sequence"):
        read_labels(store)


def test_trajectory_and_frames_that_disagree_are_refused(store: Path) -> None:
    file = store / "walls" / "trajectory.txt"
    file.write_text("".join(file.read_text().splitlines(keepends=True)[:-1]))
    with pytest.raises(InputError, match="disagree; label it again"):
        _ = read_labels(store)[0].cam_from_world


def test_a_report_without_a_camera_is_refused(store: Path) -> None:
    (store / "walls" / "run.json").write_text("{}")
    with pytest.raises(InputError, match=r"run\.json: cannot be read"):
        _ = read_labels(store)[0].camera


def test_a_sequence_without_pictures_says_so(store: Path) -> None:
    for file in (store / "walls").glob("images-*.parquet"):
        file.unlink()
    with pytest.raises(InputError):
        read_labels(store)[0].image(0)
