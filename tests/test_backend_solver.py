"""The fast solver against the NumPy reference, the truth of simulated windows, and degenerate problems."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from improvo.backend import BundleProblem, ObjectiveSettings, SolverSettings, solve
from improvo.backend.arrange import CHUNK, arrange
from improvo.backend.eliminate import eliminate
from improvo.backend.linearise import linearise
from improvo.backend.objective import cost
from improvo.backend.reduced import solve_step
from improvo.backend.reference import normal_equations, solve_dense
from improvo.backend.simulated import simulated_window
from improvo.geometry import se3
from improvo.geometry.alignment import align_points

TO_THE_END = SolverSettings(relative_decrease=1e-14, max_iterations=200)


def shuffled(problem: BundleProblem, seed: int) -> BundleProblem:
    order = np.random.default_rng(seed).permutation(len(problem.camera_index))
    return replace(
        problem,
        camera_index=problem.camera_index[order],
        point_index=problem.point_index[order],
        keypoints=problem.keypoints[order],
        weights=problem.weights[order],
    )


def with_rows(problem: BundleProblem, rows: np.ndarray) -> BundleProblem:
    return replace(
        problem,
        camera_index=problem.camera_index[rows],
        point_index=problem.point_index[rows],
        keypoints=problem.keypoints[rows],
        weights=problem.weights[rows],
    )


def one_step(problem: BundleProblem, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """The Levenberg-Marquardt step: (6 F + 3 P,) by the fast parts, and by dense linear algebra."""
    objective = ObjectiveSettings()
    constants, observations, system = arrange(problem, objective)
    linearise(constants, observations, system, problem.cam_from_world, problem.points)
    assert eliminate(observations, system, damping, 1e-6)
    assert solve_step(observations, system)
    fast = np.concatenate([system.camera_step.ravel(), system.point_step[problem.free_points].ravel()])
    hessian, gradient = normal_equations(problem, objective, problem.cam_from_world, problem.points)
    damped = hessian + damping * np.diag(np.maximum(np.diag(hessian), 1e-6))
    return fast, np.linalg.solve(damped, -gradient)


@pytest.mark.parametrize("fixed", [0, 2])
def test_step_equals_dense_linear_algebra(fixed):
    problem = shuffled(simulated_window(cameras=6, fixed=fixed, points=12, outliers=0.1).problem, 1)
    fast, dense = one_step(problem, 1e-2)
    np.testing.assert_allclose(fast, dense, atol=1e-6 * np.abs(dense).max())


def test_step_where_a_camera_saw_a_point_twice_and_tracks_have_gaps():
    problem = simulated_window(cameras=8, fixed=1, points=12).problem
    rows = np.delete(np.arange(len(problem.camera_index)), np.arange(2, len(problem.camera_index), 5))
    rows = np.concatenate([rows, rows[::3]])
    problem = shuffled(with_rows(problem, rows), 2)
    problem = replace(problem, keypoints=problem.keypoints + np.random.default_rng(3).normal(0, 0.5, (len(rows), 2)))
    fast, dense = one_step(problem, 1e-2)
    np.testing.assert_allclose(fast, dense, atol=1e-6 * np.abs(dense).max())


def test_step_with_more_cameras_than_a_chunk_holds():
    problem = simulated_window(cameras=CHUNK + 9, fixed=2, points=30, mean_track=30).problem
    fast, dense = one_step(problem, 1e-2)
    np.testing.assert_allclose(fast, dense, atol=1e-5 * np.abs(dense).max())


@pytest.mark.parametrize("outliers", [0.0, 0.1])
def test_same_optimum_as_the_reference(outliers):
    problem = simulated_window(cameras=5, fixed=2, points=15, outliers=outliers).problem
    objective = ObjectiveSettings()
    result = solve(problem, objective, TO_THE_END)
    poses, points, best = solve_dense(problem, objective, iterations=200)
    assert result.cost == pytest.approx(best, rel=1e-9)
    assert result.cost == pytest.approx(cost(problem, objective, result.cam_from_world, result.points), rel=1e-12)
    np.testing.assert_allclose(result.cam_from_world, poses, atol=1e-4)
    np.testing.assert_allclose(result.points, points, atol=1e-3)


def test_window_without_noise_is_recovered():
    window = simulated_window(cameras=30, fixed=2, points=200, noise=0.0)
    result = solve(window.problem, settings=TO_THE_END)
    assert result.converged
    assert result.initial_cost > 1e4
    assert result.cost < 1e-12
    np.testing.assert_allclose(result.cam_from_world, window.cam_from_world, atol=1e-8)
    np.testing.assert_allclose(result.points, window.points, atol=1e-6)


def test_window_with_noise_and_outliers_is_close_to_the_truth():
    window = simulated_window(cameras=30, fixed=2, points=300, noise=0.5, outliers=0.1, mean_track=15)
    result = solve(window.problem)
    assert result.converged
    true_centres = se3.inverse(window.cam_from_world)[:, :3, 3]
    centres = se3.inverse(result.cam_from_world)[:, :3, 3]
    aligned = align_points(true_centres, centres, with_scale=True).apply(centres)  # 2 fixed poses say little on scale
    offsets = np.linalg.norm(aligned - true_centres, axis=1)
    path = np.linalg.norm(np.diff(true_centres, axis=0), axis=1).sum()
    assert offsets.max() < 0.01 * path
    assert np.median(result.errors) < 0.75
    turns = se3.rotation_angle_deg(
        result.cam_from_world[:, :3, :3] @ window.cam_from_world[:, :3, :3].transpose(0, 2, 1)
    )
    assert turns.max() < 0.2


def test_default_stopping_costs_next_to_nothing():
    problem = simulated_window(cameras=30, fixed=5, points=200, outliers=0.05).problem
    early, late = solve(problem), solve(problem, settings=TO_THE_END)
    assert early.iterations < late.iterations
    assert early.cost < 1.01 * late.cost


def test_same_bits_each_time_and_in_any_order_of_the_observations_nearly():
    problem = simulated_window(cameras=20, fixed=3, points=120, outliers=0.1).problem
    first, second = solve(problem), solve(problem)
    assert first.cam_from_world.tobytes() == second.cam_from_world.tobytes()
    assert first.points.tobytes() == second.points.tobytes()
    assert first.errors.tobytes() == second.errors.tobytes()
    assert first.cost == second.cost
    other = solve(shuffled(problem, 4), settings=TO_THE_END)
    assert other.cost == pytest.approx(solve(problem, settings=TO_THE_END).cost, rel=1e-9)


def test_the_problem_is_not_changed():
    problem = simulated_window().problem
    poses, points = problem.cam_from_world.copy(), problem.points.copy()
    solve(problem)
    np.testing.assert_array_equal(problem.cam_from_world, poses)
    np.testing.assert_array_equal(problem.points, points)


def test_errors_and_depths_come_in_the_callers_order():
    window = simulated_window(noise=0.0)
    problem = shuffled(window.problem, 5)
    moved = replace(
        problem,
        keypoints=problem.keypoints + np.array([[1000.0, 0.0]]) * (np.arange(len(problem.weights)) == 7)[:, None],
    )
    result = solve(moved, settings=SolverSettings(max_iterations=0))
    assert result.iterations == 0
    assert not result.converged
    assert int(np.argmax(result.errors)) == 7
    pose = problem.cam_from_world[problem.camera_index]
    depths = np.einsum("oj,oj->o", pose[:, 2, :3], problem.points[problem.point_index]) + pose[:, 2, 3]
    np.testing.assert_allclose(result.depths, depths)


def test_pose_only():
    window = simulated_window(fixed=0, point_error=0.0, noise=0.0)
    problem = replace(window.problem, points=window.points, fixed_points=np.ones(len(window.points), bool))
    result = solve(problem, settings=TO_THE_END)
    np.testing.assert_array_equal(result.points, window.points)
    np.testing.assert_allclose(result.cam_from_world, window.cam_from_world, atol=1e-9)


def test_structure_only():
    window = simulated_window(fixed=12, noise=0.0)
    result = solve(window.problem, settings=TO_THE_END)
    np.testing.assert_array_equal(result.cam_from_world, window.cam_from_world)
    np.testing.assert_allclose(result.points, window.points, atol=1e-7)


def test_nothing_free_and_nothing_seen():
    window = simulated_window(fixed=12)
    problem = replace(window.problem, fixed_points=np.ones(len(window.points), bool))
    result = solve(problem)
    assert result.cost == result.initial_cost > 0
    np.testing.assert_array_equal(result.points, problem.points)
    empty = with_rows(simulated_window().problem, np.zeros(0, np.int64))
    result = solve(empty)
    assert (result.cost, result.iterations, result.converged) == (0.0, 0, True)
    np.testing.assert_array_equal(result.points, empty.points)


def test_free_gauge():
    window = simulated_window(fixed=0, noise=0.0)
    result = solve(window.problem, settings=TO_THE_END)
    assert result.cost < 1e-9


def test_zero_weights_count_for_nothing():
    window = simulated_window(noise=0.0)
    weights = np.ones(len(window.problem.weights))
    weights[::7] = 0.0
    keypoints = window.problem.keypoints + 300.0 * (weights == 0)[:, None]
    result = solve(replace(window.problem, weights=weights, keypoints=keypoints), settings=TO_THE_END)
    assert result.cost < 1e-9
    assert result.errors[weights == 0].min() > 100
    np.testing.assert_allclose(result.cam_from_world, window.cam_from_world, atol=1e-6)


def test_cameras_and_points_with_too_few_observations_stay_finite():
    problem = simulated_window(cameras=8, fixed=1, points=40).problem
    rows = np.arange(len(problem.camera_index))
    rows = rows[problem.camera_index[rows] != 4]  # a camera that saw nothing
    rows = rows[(problem.camera_index[rows] != 5) | (np.cumsum(problem.camera_index[rows] == 5) <= 2)]  # one with two
    rows = rows[problem.point_index[rows] != 3]  # a point that nobody saw
    once = np.flatnonzero(problem.point_index[rows] == 6)[1:]  # one that one camera saw
    sparse = with_rows(problem, np.delete(rows, once))
    for settings in (SolverSettings(), TO_THE_END):
        result = solve(sparse, settings=settings)
        assert np.isfinite(result.cam_from_world).all()
        assert np.isfinite(result.points).all()
        assert result.cost < 0.2 * result.initial_cost
        np.testing.assert_array_equal(result.points[3], sparse.points[3])
        np.testing.assert_allclose(result.cam_from_world[4], sparse.cam_from_world[4], atol=1e-14)


@pytest.mark.parametrize("seed", range(5))
def test_hopeless_starts_never_give_nan_or_a_higher_cost(seed):
    rng = np.random.default_rng(seed)
    problem = simulated_window(seed=seed, cameras=10, points=40, fixed=seed % 3).problem
    points = rng.normal(0.0, 10.0 ** rng.integers(-8, 9), problem.points.shape)
    points[:3] = se3.inverse(problem.cam_from_world)[0, :3, 3]  # in the middle of a camera
    wild = replace(problem, points=points, keypoints=problem.keypoints * 10.0 ** rng.integers(0, 6))
    result = solve(wild, settings=TO_THE_END)
    assert np.isfinite(result.points).all()
    assert np.isfinite(result.cam_from_world).all()
    assert result.cost <= result.initial_cost < np.inf
    rotations = result.cam_from_world[:, :3, :3]
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), np.tile(np.eye(3), (10, 1, 1)), atol=1e-9)


def test_time_is_measured_where_asked():
    problem = simulated_window().problem
    assert solve(problem).seconds == {}
    seconds = solve(problem, timed=True).seconds
    assert set(seconds) == {"arrange", "linearise", "eliminate", "solve", "evaluate"}
    assert min(seconds.values()) > 0
