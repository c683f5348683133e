"""Many-view triangulation with the poses held."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from improvo.backend.simulated import simulated_window
from improvo.errors import ConfigError
from improvo.geometry.settings import TriangulationSettings
from improvo.geometry.triangulation import triangulate_tracks

LOSSES = ("huber", "geman_mcclure")


def tracks_of(window):
    """Observations of a simulated window as tracks under the true poses: what `triangulate_tracks` takes."""
    problem = window.problem
    counts = np.bincount(problem.point_index, minlength=len(problem.points))
    offsets = np.concatenate([[0], np.cumsum(counts)])
    assert (np.diff(problem.point_index) >= 0).all()
    return [problem.keypoints.copy(), problem.camera_index.copy(), offsets, window.cam_from_world.copy(), problem.K]


@pytest.mark.parametrize("loss", LOSSES)
def test_exact_without_noise(loss):
    window = simulated_window(cameras=20, points=50, noise=0.0)
    result = triangulate_tracks(*tracks_of(window), TriangulationSettings(loss=loss))
    np.testing.assert_allclose(result.points, window.points, atol=1e-5)
    assert result.errors.max() < 1e-6
    assert result.in_front.all()


@pytest.mark.parametrize("loss", LOSSES)
def test_within_the_noise(loss):
    window = simulated_window(cameras=40, points=200, noise=0.5, mean_track=20)
    result = triangulate_tracks(*tracks_of(window), TriangulationSettings(loss=loss))
    wide = result.parallax_deg > 5
    assert wide.sum() > 20
    assert np.linalg.norm(result.points - window.points, axis=1)[wide].max() < 0.15
    assert 0.45 < np.median(result.errors) < 0.7  # Rayleigh: 0.59


def test_parallax_is_the_angle_at_the_point():
    cam_from_world = np.tile(np.eye(4), (3, 1, 1))
    cam_from_world[:, 0, 3] = (0.5, 0.0, -0.5)  # centres at x = -0.5, 0, 0.5; the point is one unit ahead
    K = np.array([[100.0, 0.0, 50.0], [0.0, 100.0, 50.0], [0.0, 0.0, 1.0]])
    keypoints = np.array([[100.0, 50.0], [50.0, 50.0], [0.0, 50.0]])
    arguments = (keypoints, np.arange(3), np.array([0, 3]), cam_from_world, K)
    result = triangulate_tracks(*arguments, TriangulationSettings(min_parallax_deg=53.0))
    np.testing.assert_allclose(result.points, [[0.0, 0.0, 1.0]], atol=1e-9)
    np.testing.assert_allclose(result.parallax_deg, 2 * np.degrees(np.arctan(0.5)))
    assert result.ok.all()
    assert not triangulate_tracks(*arguments, TriangulationSettings(min_parallax_deg=54.0)).ok.any()


@pytest.mark.parametrize("loss", LOSSES)
def test_one_wrong_view_does_not_pull_the_point(loss):
    window = simulated_window(cameras=30, points=80, noise=0.2, mean_track=25)
    arguments = tracks_of(window)
    clean = triangulate_tracks(*arguments, TriangulationSettings(loss=loss))
    long_enough = np.flatnonzero(np.diff(arguments[2]) >= 8)
    assert len(long_enough) > 20
    wrong = arguments[2][long_enough] + 3
    arguments[0][wrong, 1] += 60.0
    result = triangulate_tracks(*arguments, TriangulationSettings(loss=loss))
    assert result.errors[wrong].min() > 50
    moved = np.linalg.norm(result.points - clean.points, axis=1)[long_enough]
    limit = 0.1 if loss == "huber" else 0.02
    assert np.median(moved) < limit * np.median(window.points[:, 2])


def test_redescending_loss_shows_a_wrong_link_in_full():
    """A track that jumps to another point: Huber settles between the two, Geman-McClure stays with the longer part."""
    window = simulated_window(cameras=20, points=40, noise=0.2, mean_track=100)
    arguments = tracks_of(window)
    offsets = arguments[2]
    long_enough = np.flatnonzero(np.diff(offsets) >= 10)
    assert len(long_enough) > 5
    jumps = offsets[long_enough] + (0.6 * np.diff(offsets)[long_enough]).astype(int)
    for track, jump in zip(long_enough, jumps, strict=True):
        arguments[0][jump : offsets[track + 1], 1] += 7.0
    result = triangulate_tracks(*arguments, TriangulationSettings(loss="geman_mcclure"))
    for track, jump in zip(long_enough, jumps, strict=True):
        assert result.errors[offsets[track] : jump].max() < 2.0
        assert result.errors[jump : offsets[track + 1]].min() > 5.0


def test_cameras_without_a_pose_are_left_out():
    window = simulated_window(cameras=20, points=50, noise=0.0, mean_track=15)
    arguments = tracks_of(window)
    arguments[3][5] = np.nan
    result = triangulate_tracks(*arguments)
    lost = arguments[1] == 5
    assert np.isnan(result.errors[lost]).all()
    assert lost.sum() > 0
    found = np.isfinite(result.points).all(axis=1)
    np.testing.assert_allclose(result.points[found], window.points[found], atol=1e-5)
    arguments[3][:] = np.nan
    result = triangulate_tracks(*arguments)
    assert np.isnan(result.points).all()
    assert not result.ok.any()


def test_short_empty_and_degenerate_tracks():
    window = simulated_window(cameras=20, points=5, noise=0.0)
    keypoints, cameras, _, poses, K = tracks_of(window)
    # empty, one view, the same view twice (no parallax), two views
    rows = np.array([0, 1, 1, 0, 2])
    result = triangulate_tracks(keypoints[rows], cameras[rows], np.array([0, 0, 1, 3, 5]), poses, K)
    assert np.isnan(result.points[:2]).all()
    assert np.isfinite(result.points[2:]).all()
    assert result.parallax_deg[2] < 1e-3
    assert not result.ok[:3].any()
    nothing = triangulate_tracks(np.zeros((0, 2)), np.zeros(0, np.int64), np.array([0]), poses, K)
    assert nothing.points.shape == (0, 3)


def test_diverging_rays_are_not_ok():
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = -0.2
    K = np.array([[100.0, 0.0, 50.0], [0.0, 100.0, 50.0], [0.0, 0.0, 1.0]])
    result = triangulate_tracks(np.array([[40.0, 50.0], [60.0, 50.0]]), np.arange(2), np.array([0, 2]), poses, K)
    assert np.isfinite(result.points).all()
    assert not result.ok.any()


def test_same_bits_each_time():
    arguments = tracks_of(simulated_window(cameras=30, points=100, outliers=0.1))
    first, second = triangulate_tracks(*arguments), triangulate_tracks(*arguments)
    assert first.points.tobytes() == second.points.tobytes()
    assert first.errors.tobytes() == second.errors.tobytes()


@pytest.mark.parametrize("offsets", [[0, 2], [1, 3], [0, 3, 2, 3], []])
def test_offsets_that_do_not_fit_are_refused(offsets):
    with pytest.raises(ValueError, match="track_offsets"):
        triangulate_tracks(np.zeros((3, 2)), np.zeros(3, np.int64), np.array(offsets), np.eye(4)[None], np.eye(3))


def test_impossible_settings_are_refused():
    with pytest.raises(ConfigError, match="loss"):
        TriangulationSettings(loss="cauchy")


def test_settings_and_problems_import_without_numba():
    code = "import sys, improvo.backend; improvo.backend.ObjectiveSettings(); sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_kernels_compile_ahead_of_time():
    from improvo.backend.compile import compile_kernels, kernels_are_cached

    compile_kernels()
    said: list[str] = []
    assert kernels_are_cached()
    compile_kernels(said.append)
    assert said == []


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("wrong", [0, 2])
def test_no_other_point_has_a_lower_cost(loss, wrong):
    """Against brute force: a simplex search from the truth and from many places around it."""
    from scipy.optimize import minimize

    rng = np.random.default_rng(wrong)
    window = simulated_window(seed=4, cameras=10, points=12, noise=0.8)
    keypoints, camera_index, offsets, poses, K = tracks_of(window)
    for start, end in itertools.pairwise(offsets):
        keypoints[start : min(start + wrong, end - 3)] += rng.normal(scale=12.0, size=2)
    settings = TriangulationSettings(loss=loss, loss_width=1.5, max_iterations=50)
    found = triangulate_tracks(keypoints, camera_index, offsets, poses, K, settings)

    for j, (start, end) in enumerate(itertools.pairwise(offsets)):
        seen, by = keypoints[start:end], poses[camera_index[start:end]]

        def cost(point, seen=seen, by=by):
            in_camera = by[:, :3, :3] @ point + by[:, :3, 3]
            squared = (((in_camera @ K.T)[:, :2] / in_camera[:, 2:] - seen) ** 2).sum(axis=1)
            if loss == "geman_mcclure":
                return (squared / (1.0 + squared / 1.5**2)).sum()
            return np.where(squared <= 1.5**2, squared, 3.0 * np.sqrt(squared) - 1.5**2).sum()

        starts = [window.points[j], *(window.points[j] + rng.normal(scale=0.3, size=(6, 3)))]
        options = {"maxiter": 2000, "xatol": 1e-9, "fatol": 1e-9}
        best = min(minimize(cost, x, method="Nelder-Mead", options=options).fun for x in starts)
        assert cost(found.points[j]) <= best + 1e-3 * (1.0 + best), f"track {j}"


def test_a_run_compiles_nothing_after_its_first_frame():
    """In a fresh process: once `compile_odometry` is done, no kernel meets a new signature."""
    code = """
import sys
from pathlib import Path
import numpy as np
from numba.core.registry import CPUDispatcher
from simulated_features import CAMERA, hand_motion, observe, room
from improvo.frontend.corners import refine_to_corners
from improvo.odometry.run.compile import compile_odometry
from improvo.odometry.visual_odometry import VisualOdometry
from improvo.stability.rule import label_stability

def signatures():
    rooms = [module for name, module in list(sys.modules.items()) if name.startswith("improvo")]
    found = {value for module in rooms for value in vars(module).values() if isinstance(value, CPUDispatcher)}
    return {(kernel.py_func.__qualname__, str(types)) for kernel in found for types in kernel.signatures}

compile_odometry()
before = signatures()
odometry = VisualOdometry(None, CAMERA)
for i, pose in enumerate(hand_motion(40)):
    odometry.track_features(observe(room(), pose, seed=i), i / 30)
odometry.finish()
assert len(odometry.map) > 100
refine_to_corners(np.random.default_rng(0).random((60, 80)), np.full((3, 2), 20.0, np.float32), radius=3)
print(sorted(signatures() - before))
"""
    tests = str(Path(__file__).parent)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([tests, os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr


def test_kernels_work_where_nothing_can_be_cached(monkeypatch):
    from numba import njit

    from improvo import compiled as module

    def no_writable_folder(**options):
        if options.pop("cache", False):
            raise RuntimeError("cannot cache function: no locator available")
        return njit(**options)

    monkeypatch.setattr(module, "njit", no_writable_folder)
    double = module.compiled(lambda x: 2.0 * x)
    assert double(4.0) == 8.0
    assert double.stats.cache_path is None
