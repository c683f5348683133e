"""The objective's values by hand, and its derivatives by finite differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from improvo.backend import BundleProblem, ObjectiveSettings
from improvo.backend.arrange import arrange
from improvo.backend.linearise import errors_and_depths, evaluate, linearise
from improvo.backend.objective import cost, huber, huber_slope, reprojection_errors, residuals
from improvo.backend.reference import normal_equations
from improvo.backend.simulated import simulated_window
from improvo.errors import ConfigError

# depths of 1.5 to 4.5: with these limits both sides of the depth regulariser are at work
TIGHT_DEPTHS = ObjectiveSettings(huber_width=1.0, depth_min=2.0, depth_max=3.0, depth_weight=3.0)


def one_observation(point: tuple[float, float, float], keypoint: tuple[float, float], weight: float) -> BundleProblem:
    K = np.array([[100.0, 0.0, 50.0], [0.0, 200.0, 40.0], [0.0, 0.0, 1.0]])
    return BundleProblem(
        cam_from_world=np.eye(4)[None],
        points=np.array([point]),
        camera_index=np.array([0]),
        point_index=np.array([0]),
        keypoints=np.array([keypoint]),
        weights=np.array([weight]),
        K=K,
        fixed_cameras=np.array([False]),
    )


def test_huber_by_hand():
    assert huber(np.array([0.0, 1.0, 4.0, 9.0, 100.0]), 2.0).tolist() == [0.0, 1.0, 4.0, 8.0, 36.0]
    assert huber_slope(np.array([0.0, 4.0, 16.0, 100.0]), 2.0).tolist() == [1.0, 1.0, 0.5, 0.2]


@pytest.mark.parametrize(
    ("point", "keypoint", "weight", "expected_residuals", "expected_cost"),
    [
        # projects to (150, 140): 3 px and 4 px off, Huber width 2 -> 2 * 2 * 5 - 4
        ((1.0, 0.5, 1.0), (147.0, 136.0), 0.5, (3, 4, 0, 0), 0.5 * 16),
        # Z = 8 is 3 above depth_max: no pixel error, s = 9 -> 2 * 2 * 3 - 4
        ((0.0, 0.0, 8.0), (50.0, 40.0), 1.0, (0, 0, 3, 0), 8),
        # Z = 0.05 is 0.05 under depth_min: quadratic
        ((0.0, 0.0, 0.05), (50.0, 40.0), 1.0, (0, 0, 0, -0.05), 0.0025),
        # behind the camera the projection is mirrored, and only the depth speaks: Z = -0.9, s = 1
        ((-0.9, 0.0, -0.9), (150.0, 40.0), 1.0, (0, 0, 0, -1), 1),
        # pixel and depth terms are one vector under one Huber loss: (3, 4, 12) -> s = 169 -> 2 * 2 * 13 - 4
        ((0.0, 0.0, 17.0), (47.0, 36.0), 1.0, (3, 4, 12, 0), 48),
    ],
)
def test_objective_by_hand(point, keypoint, weight, expected_residuals, expected_cost):
    objective = ObjectiveSettings(huber_width=2.0)
    problem = one_observation(point, keypoint, weight)
    np.testing.assert_allclose(
        residuals(problem, objective, problem.cam_from_world, problem.points)[0], expected_residuals, atol=1e-12
    )
    assert cost(problem, objective, problem.cam_from_world, problem.points) == pytest.approx(expected_cost)
    constants, observations, _ = arrange(problem, objective)
    assert evaluate(constants, observations, problem.cam_from_world, problem.points) == pytest.approx(expected_cost)


@pytest.mark.parametrize("z", [0.0, 1e-9, -1e-9])
def test_point_in_the_plane_of_the_camera_has_a_finite_cost(z):
    problem = one_observation((0.1, 0.1, z), (0.0, 0.0), 1.0)
    objective = ObjectiveSettings()
    expected = cost(problem, objective, problem.cam_from_world, problem.points)
    constants, observations, _ = arrange(problem, objective)
    assert 1e6 < expected < np.inf
    assert evaluate(constants, observations, problem.cam_from_world, problem.points) == pytest.approx(expected)


def test_depth_weight_zero_turns_the_regulariser_off():
    problem = one_observation((0.0, 0.0, 50.0), (50.0, 40.0), 1.0)
    assert cost(problem, ObjectiveSettings(), problem.cam_from_world, problem.points) > 0
    assert cost(problem, ObjectiveSettings(depth_weight=0.0), problem.cam_from_world, problem.points) == 0


@pytest.mark.parametrize("objective", [ObjectiveSettings(), ObjectiveSettings(huber_width=1e6), TIGHT_DEPTHS])
def test_compiled_objective_equals_the_reference(objective):
    problem = simulated_window(outliers=0.1).problem
    constants, observations, _ = arrange(problem, objective)
    expected = cost(problem, objective, problem.cam_from_world, problem.points)
    assert evaluate(constants, observations, problem.cam_from_world, problem.points) == pytest.approx(
        expected, rel=1e-12
    )
    errors, depths = errors_and_depths(constants, observations, problem.cam_from_world, problem.points)
    np.testing.assert_allclose(errors, reprojection_errors(problem, problem.cam_from_world, problem.points), rtol=1e-9)
    assert depths.min() > 0.5


@pytest.mark.parametrize("objective", [ObjectiveSettings(), ObjectiveSettings(huber_width=1e6), TIGHT_DEPTHS])
def test_analytic_derivatives_equal_finite_differences(objective):
    window = simulated_window(cameras=5, fixed=1, points=9, outliers=0.1)
    fixed_points = np.arange(9) >= 7
    problem = replace(window.problem, fixed_points=fixed_points)
    hessian, gradient = normal_equations(problem, objective, problem.cam_from_world, problem.points)
    constants, observations, system = arrange(problem, objective)
    linearise(constants, observations, system, problem.cam_from_world, problem.points)

    cameras, points = 4, 7
    scale = np.abs(gradient).max()
    np.testing.assert_allclose(system.camera_gradient.ravel(), gradient[: 6 * cameras], atol=1e-7 * scale)
    np.testing.assert_allclose(system.point_gradient[:points].ravel(), gradient[6 * cameras :], atol=1e-7 * scale)

    scale = np.abs(hessian).max()
    upper = np.triu_indices(6)
    for camera in range(cameras):
        block = hessian[6 * camera : 6 * camera + 6, 6 * camera : 6 * camera + 6]
        np.testing.assert_allclose(system.camera_hessian[camera][upper], block[upper], atol=1e-7 * scale)
    for j in range(points):
        block = hessian[6 * cameras + 3 * j :, 6 * cameras + 3 * j :][:3, :3]
        np.testing.assert_allclose(system.point_hessian[j], block[np.triu_indices(3)], atol=1e-7 * scale)
    coupling = np.zeros((6 * cameras, 3 * points))
    for o in range(len(observations.order)):
        camera, j = observations.free_camera[o], problem.point_index[observations.order[o]]
        if camera < cameras and j < points:
            x, y, z = system.in_camera[o]
            lever = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            block = np.vstack([system.coupling[o], lever @ system.coupling[o]])
            coupling[6 * camera : 6 * camera + 6, 3 * j : 3 * j + 3] += block
    np.testing.assert_allclose(coupling, hessian[: 6 * cameras, 6 * cameras :], atol=1e-7 * scale)


def test_gradient_is_that_of_the_cost():
    """Not only of re-weighted least squares: the finite difference of Omega itself."""
    problem = simulated_window(cameras=4, fixed=1, points=8, outliers=0.2).problem
    constants, observations, system = arrange(problem, TIGHT_DEPTHS)
    linearise(constants, observations, system, problem.cam_from_world, problem.points)
    for j in range(8):
        for axis in range(3):
            step = np.zeros((8, 3))
            step[j, axis] = 1e-6
            ahead = cost(problem, TIGHT_DEPTHS, problem.cam_from_world, problem.points + step)
            behind = cost(problem, TIGHT_DEPTHS, problem.cam_from_world, problem.points - step)
            slope = (ahead - behind) / 2e-6
            assert 2 * system.point_gradient[j, axis] == pytest.approx(slope, rel=1e-5, abs=1e-2)


@pytest.mark.parametrize(
    "values", [{"huber_width": 0.0}, {"depth_min": 6.0}, {"depth_weight": -1.0}, {"huber_width": float("nan")}]
)
def test_impossible_settings_are_refused(values):
    with pytest.raises(ConfigError):
        ObjectiveSettings(**values)


@pytest.mark.parametrize(
    "change",
    [
        {"camera_index": np.array([1])},
        {"point_index": np.array([-1])},
        {"weights": np.array([-0.1])},
        {"keypoints": np.array([[np.nan, 0.0]])},
        {"points": np.zeros((1, 2))},
        {"K": np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])},
        {"fixed_points": np.array([True, False])},
    ],
)
def test_impossible_problems_are_refused(change):
    problem = one_observation((0.0, 0.0, 1.0), (50.0, 40.0), 1.0)
    with pytest.raises(ValueError, match="BundleProblem"):
        replace(problem, **change)
