"""Robust poses on matches with outliers, by PoseLib and by OpenCV; the epipolar maths against its definition."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from simulated_features import CAMERA

from improvo.geometry import se3
from improvo.geometry.epipolar import epipolar_lines, in_front_of_both, rotation_residuals, sampson_errors, skew
from improvo.geometry.ransac import Ransac, RobustSolver, poselib_installed, robust_solver
from improvo.types import Float64

SOURCE = Path(__file__).parents[1] / "src" / "improvo"
B_FROM_A = se3.rigid(se3.so3_exp(np.array([0.02, -0.08, 0.01])), np.array([-0.5, 0.03, 0.1]))


@pytest.fixture(params=["poselib", "opencv"])
def solver(request: pytest.FixtureRequest) -> RobustSolver:
    if request.param == "poselib" and not poselib_installed():
        pytest.skip("PoseLib is not installed")
    return robust_solver(request.param)


def points_before_both(count: int = 200, seed: int = 0) -> Float64:
    """(N, 3) in camera a, 2 to 6 away."""
    rng = np.random.default_rng(seed)
    return CAMERA.unproject(rng.uniform((60, 40), (260, 200), (count, 2)), rng.uniform(2.0, 6.0, count))


def seen_in_both(points: Float64, b_from_a: Float64 = B_FROM_A) -> tuple[Float64, Float64]:
    return CAMERA.project(points), CAMERA.project(se3.transform(b_from_a, points))


def same_motion(found: Float64, true: Float64) -> None:
    """Rotation within 0.1 degrees, direction of the translation within 1 degree."""
    assert se3.rotation_angle_deg(found[:3, :3].T @ true[:3, :3]) < 0.1
    cosine = found[:3, 3] @ true[:3, 3] / np.linalg.norm(found[:3, 3]) / np.linalg.norm(true[:3, 3])
    assert np.degrees(np.arccos(min(cosine, 1.0))) < 1.0


def test_relative_pose_survives_a_third_of_wrong_matches(solver: RobustSolver) -> None:
    pixels_a, pixels_b = seen_in_both(points_before_both())
    pixels_b[::3] = np.random.default_rng(1).uniform((0, 0), (320, 240), (len(pixels_b[::3]), 2))
    found = solver.relative_pose(pixels_a, pixels_b, CAMERA, Ransac(1.0, seed=0))
    same_motion(found.pose, B_FROM_A)
    assert np.linalg.norm(found.pose[:3, 3]) == pytest.approx(1.0)
    right = np.arange(len(pixels_a)) % 3 != 0
    assert found.inliers[right].mean() > 0.95
    assert found.inliers[~right].mean() < 0.1


def test_absolute_pose_survives_a_third_of_wrong_matches(solver: RobustSolver) -> None:
    points = points_before_both()
    pixels = seen_in_both(points)[1]
    pixels[::3] += 40.0
    found = solver.absolute_pose(points, pixels, CAMERA, Ransac(2.0, seed=0))
    np.testing.assert_allclose(found.pose, B_FROM_A, atol=1e-3)
    assert not found.inliers[::3].any()


def test_the_same_seed_gives_the_same_bits(solver: RobustSolver) -> None:
    pixels_a, pixels_b = seen_in_both(points_before_both())
    pixels_b += np.random.default_rng(2).normal(scale=1.0, size=pixels_b.shape)
    first, second = (solver.relative_pose(pixels_a, pixels_b, CAMERA, Ransac(1.0, seed=3)) for _ in range(2))
    assert first.pose.tobytes() == second.pose.tobytes()


def test_the_homography_of_a_plane_stands_for_its_motion(solver: RobustSolver) -> None:
    points = points_before_both()
    points[:, 2] = 3.0 + 0.2 * points[:, 0] / points[:, 2]
    points[:, :2] = CAMERA.unproject(CAMERA.project(points))[:, :2] * points[:, 2:]
    plane = np.linalg.lstsq(points, np.ones(len(points)), rcond=None)[0]
    points /= (points @ plane)[:, None]  # exactly on one plane
    pixels_a, pixels_b = seen_in_both(points)
    found = solver.homography(pixels_a, pixels_b, Ransac(1.0, seed=0))
    assert found.inliers.all()
    carried = np.column_stack([pixels_a, np.ones(len(pixels_a))]) @ found.b_from_a.T
    np.testing.assert_allclose(carried[:, :2] / carried[:, 2:], pixels_b, atol=5e-3)  # OpenCV counts in float32
    motions = solver.motions_of_homography(found.b_from_a, CAMERA)
    assert 1 <= len(motions) <= 4
    same_motion(min(motions, key=lambda motion: se3.rotation_angle_deg(motion[:3, :3].T @ B_FROM_A[:3, :3])), B_FROM_A)


def test_the_homography_of_a_rotation_stands_for_no_motion(solver: RobustSolver) -> None:
    rotation = se3.so3_exp(np.array([0.0, 0.1, 0.0]))
    assert solver.motions_of_homography(CAMERA.K @ rotation @ np.linalg.inv(CAMERA.K), CAMERA) == []


def test_a_rotation_leaves_nothing_of_a_turn_and_much_of_a_step() -> None:
    points = points_before_both()
    turned = se3.rigid(B_FROM_A[:3, :3], np.zeros(3))
    assert np.median(rotation_residuals(CAMERA, *seen_in_both(points, turned))) < 0.01
    assert np.median(rotation_residuals(CAMERA, *seen_in_both(points))) > 3.0


def test_sampson_errors_are_pixels_from_the_line() -> None:
    b_from_a = se3.rigid(np.eye(3), np.array([1.0, 0.0, 0.0]))  # sideways: epipolar lines are rows
    pixels_a = np.array([[100.0, 80.0], [200.0, 120.0]])
    pixels_b = pixels_a + np.array([[30.0, 0.0], [10.0, 2.0]])
    np.testing.assert_allclose(sampson_errors(b_from_a, CAMERA, pixels_a, pixels_b), [0.0, 2.0 / np.sqrt(2)], atol=1e-9)


def test_epipolar_lines_pass_through_the_matches() -> None:
    pixels_a, pixels_b = seen_in_both(points_before_both(50))
    lines = epipolar_lines(B_FROM_A, CAMERA, pixels_a)
    distances = (lines[:, :2] * pixels_b).sum(axis=1) + lines[:, 2]
    np.testing.assert_allclose(distances / np.linalg.norm(lines[:, :2], axis=1), 0.0, atol=1e-9)
    moved = pixels_b + lines[:, :2] / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    np.testing.assert_array_less(0.5, sampson_errors(B_FROM_A, CAMERA, pixels_a, moved))


def test_points_lie_in_front_of_both_cameras_under_one_sign_of_the_translation() -> None:
    pixels_a, pixels_b = seen_in_both(points_before_both(50))
    assert in_front_of_both(B_FROM_A, CAMERA, pixels_a, pixels_b).all()
    backwards = se3.rigid(B_FROM_A[:3, :3], -B_FROM_A[:3, 3])
    assert not in_front_of_both(backwards, CAMERA, pixels_a, pixels_b).any()


def test_skew_is_the_cross_product() -> None:
    a, b = np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.7, -1.1])
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b))


def test_views_of_a_wall_and_a_turn_are_told_by_their_homography(solver: RobustSolver) -> None:
    points = points_before_both()
    turned = se3.rigid(B_FROM_A[:3, :3], np.zeros(3))
    pixels_a, pixels_b = seen_in_both(points, turned)
    assert solver.homography(pixels_a, pixels_b, Ransac(1.0, seed=0)).inliers.all()
    assert solver.homography(pixels_a, seen_in_both(points)[1], Ransac(1.0, seed=0)).inliers.mean() < 0.5


@pytest.mark.parametrize("count", [0, 1, 3])
def test_too_few_matches_agree_on_nothing(solver: RobustSolver, count: int) -> None:
    points = points_before_both()[:count]
    pixels_a, pixels_b = seen_in_both(points)
    for found in (
        solver.absolute_pose(points, pixels_b, CAMERA, Ransac(1.0, seed=0)),
        solver.relative_pose(pixels_a, pixels_b, CAMERA, Ransac(1.0, seed=0)),
        solver.homography(pixels_a, pixels_b, Ransac(1.0, seed=0)),
    ):
        assert found.inliers.shape == (count,)
        assert not found.inliers.any()


def test_chance_matches_agree_on_little(solver: RobustSolver) -> None:
    rng = np.random.default_rng(4)
    pixels_a, pixels_b = rng.uniform((0, 0), (320, 240), (2, 200, 2))
    points = points_before_both()
    ransac = Ransac(1.0, seed=0, max_iterations=500)
    assert solver.absolute_pose(points, pixels_b, CAMERA, ransac).inliers.mean() < 0.1
    assert solver.relative_pose(pixels_a, pixels_b, CAMERA, ransac).inliers.mean() < 0.3


def test_both_solvers_find_the_same_poses_in_noise() -> None:
    if not poselib_installed():
        pytest.skip("PoseLib is not installed")
    rng = np.random.default_rng(5)
    points = points_before_both(400)
    pixels_a, pixels_b = seen_in_both(points)
    pixels_a = pixels_a + rng.normal(scale=0.5, size=pixels_a.shape)
    pixels_b = pixels_b + rng.normal(scale=0.5, size=pixels_b.shape)
    pixels_b[::4] = rng.uniform((0, 0), (320, 240), (100, 2))
    solvers = robust_solver("poselib"), robust_solver("opencv")
    ransac = Ransac(2.0, seed=0, min_iterations=100, max_iterations=2000)
    first, second = (one.absolute_pose(points, pixels_b, CAMERA, ransac) for one in solvers)
    assert se3.rotation_angle_deg(first.pose[:3, :3].T @ second.pose[:3, :3]) < 0.05
    np.testing.assert_allclose(first.pose[:3, 3], second.pose[:3, 3], atol=5e-3)
    assert (first.inliers == second.inliers).mean() > 0.98
    first, second = (one.relative_pose(pixels_a, pixels_b, CAMERA, ransac) for one in solvers)
    assert se3.rotation_angle_deg(first.pose[:3, :3].T @ second.pose[:3, :3]) < 0.2
    directions = [one.pose[:3, 3] / np.linalg.norm(one.pose[:3, 3]) for one in (first, second)]
    assert directions[0] @ directions[1] > np.cos(np.radians(2.0))
    assert (first.inliers == second.inliers).mean() > 0.95


def test_without_poselib_opencv_takes_its_place() -> None:
    program = """
import sys
sys.modules["poselib"] = None
from improvo.evaluation.settings import PoseSettings
from improvo.geometry.ransac import robust_solver
import improvo.odometry.visual_odometry
assert robust_solver().name == "opencv"
assert PoseSettings().estimators == ("opencv", "usac")
"""
    subprocess.run([sys.executable, "-c", program], check=True)


def test_only_one_module_imports_poselib() -> None:
    callers = set()
    for file in SOURCE.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if any(name.split(".")[0] == "poselib" for name in names):
                callers.add(str(file.relative_to(SOURCE)))
    assert callers == {"geometry/ransac_poselib.py"}
