"""What somebody hands to the Python API by mistake is said in one line, before any work."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import improvo
from improvo.frontend.weights_files import find_weights, load_weights
from improvo.labeling.labeled import read_labels
from improvo.simulation import bundled_sequence

CAMERA = improvo.Camera(96, 72, 90.0, 90.0, 47.5, 35.5)
PICTURE = np.random.default_rng(0).integers(0, 255, (72, 96)).astype(np.uint8)
POSES = improvo.Trajectory(np.arange(5.0), np.tile(np.eye(4), (5, 1, 1)))
FEW = improvo.LabelRunSettings(improvo.SequenceSettings(max_frames=20), improvo.FrontendSettings("orb", 300))


@pytest.fixture
def orb() -> improvo.Frontend:
    return improvo.load_frontend("orb", 200)


@pytest.mark.parametrize("name", ["superpoint-vo", Path("weights.safetensors")])
def test_the_odometry_wants_a_frontend_and_not_its_name(name: Any) -> None:
    with pytest.raises(TypeError, match=r"frontend: is a \w+, give `improvo.load_frontend\('"):
        improvo.VisualOdometry(name, CAMERA)


def test_the_odometry_wants_a_camera_without_distortion(orb: improvo.Frontend) -> None:
    with pytest.raises(TypeError, match=r"camera: is a tuple, give an `improvo.Camera`"):
        improvo.VisualOdometry(orb, (90.0, 90.0, 47.5, 35.5))  # type: ignore[arg-type]
    for distortion, model in (((0.1, 0.0, 0.0, 0.0), "brown"), ((0.0, 0.0, 0.0, 0.0), "fisheye")):
        distorted = improvo.Camera(96, 72, 90.0, 90.0, 47.5, 35.5, distortion, model)
        with pytest.raises(improvo.InputError, match=r"camera: has distortion, .* undistort the pictures"):
            improvo.VisualOdometry(orb, distorted)
    improvo.VisualOdometry(orb, improvo.Camera(96, 72, 90.0, 90.0, 47.5, 35.5, (0.0, 0.0, 0.0, 0.0)))


def test_the_odometry_tracks_frames_and_not_bare_pictures(orb: improvo.Frontend) -> None:
    odometry = improvo.VisualOdometry(orb, CAMERA)
    with pytest.raises(TypeError, match=r"frame: is a ndarray; give `improvo.Frame\("):
        odometry.track(PICTURE)  # type: ignore[arg-type]
    assert odometry.track(improvo.Frame(0, 0.0, PICTURE, "my camera")).frame_index == 0


@pytest.mark.parametrize("name", ["orb", "superpoint-vo-small"])
def test_a_frontend_reads_arrays_and_names_what_imread_gives_for_a_missing_file(name: str) -> None:
    frontend: Any = improvo.load_frontend(name, 100)
    with pytest.raises(improvo.InputError, match=r"image: is a NoneType, give a NumPy array .* cv2.imread gives None"):
        frontend(None)
    with pytest.raises(improvo.InputError, match="image: is a str, give a NumPy array"):
        frontend("picture.jpg")


@pytest.mark.parametrize("name", ["sift", "orb", "superpoint-vo"])
@pytest.mark.parametrize("count", [0, -1])
def test_a_frontend_without_keypoints(name: str, count: int) -> None:
    with pytest.raises(improvo.ConfigError, match="`max_keypoints`: must be at least 1"):
        improvo.load_frontend(name, count)


def test_features_of_two_frontends_do_not_match() -> None:
    orb, sift, network = (improvo.load_frontend(name, 100)(PICTURE) for name in ("orb", "sift", "superpoint-vo"))
    for a, b in ((orb, sift), (sift, network), (network, orb)):  # 256 bits and 256 numbers would give matches
        with pytest.raises(improvo.InputError, match="cannot be matched; use one frontend for both"):
            improvo.match(a, b)


def test_a_trajectory_has_a_matrix_for_each_time() -> None:
    for poses in (np.zeros((5, 7)), np.zeros((4, 4, 4)), np.zeros((5, 3, 4))):
        with pytest.raises(ValueError, match=r"Trajectory.world_from_cam: shape .* expected \(5, 4, 4\)"):
            improvo.Trajectory(np.arange(5.0), poses)
    for segment in (np.zeros(4, np.int64), np.zeros(6, np.int64), np.zeros((5, 1), np.int64)):
        with pytest.raises(ValueError, match=r"Trajectory.segment: shape .* expected \(5,\), a number for each time"):
            improvo.Trajectory(np.arange(5.0), np.tile(np.eye(4), (5, 1, 1)), segment)


def test_a_trajectory_is_evaluated_and_not_what_has_one(orb: improvo.Frontend) -> None:
    sequence, odometry = improvo.open_sequence(bundled_sequence()), improvo.VisualOdometry(orb, CAMERA)
    for estimate, truth in ((odometry, POSES), (POSES, sequence), (POSES.world_from_cam, POSES)):
        with pytest.raises(TypeError, match=r"such as `odometry.trajectory` or `sequence.ground_truth`"):
            improvo.evaluate_trajectory(estimate, truth)  # type: ignore[arg-type]


def test_one_path_counts_as_a_list_of_one(tmp_path: Path) -> None:
    [record] = improvo.label(str(bundled_sequence()), tmp_path / "labels", FEW)
    assert record.state == "done"
    assert [sequence.record.name for sequence in read_labels(str(tmp_path / "labels"))] == [record.name]
    settings = improvo.PoseSettings(gaps=(5,), pairs=4, estimators=("poselib",))
    [cell] = improvo.evaluate_pose(str(bundled_sequence()), "orb", settings)
    assert (cell.frontend, cell.pairs) == ("orb", 4)
    with pytest.raises(improvo.InputError, match="nowhere"):
        improvo.improve("nowhere", tmp_path / "better")
    with pytest.raises(improvo.InputError, match="nowhere"):
        improvo.train_odometry("nowhere", tmp_path / "weights")


def test_a_run_by_weights_at_a_path(tmp_path: Path) -> None:
    frontend = improvo.load_frontend(find_weights("superpoint-vo-small"), 200)
    improvo.run(bundled_sequence(), tmp_path / "run", FEW, frontend)
    run = improvo.RunFolder(str(tmp_path / "run"))
    assert run.report["frontend"].endswith("superpoint-vo-small.safetensors")
    assert run.frames == 20


def test_weights_show_their_card_and_not_their_numbers() -> None:
    shown = repr(load_weights(find_weights("superpoint-vo-small")))
    assert "superpoint-small" in shown
    assert "array(" not in shown
