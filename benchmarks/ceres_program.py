"""Builds the small Ceres program of the benchmark with CMake and runs it on a `BundleProblem`."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from improvo.backend import BundleProblem, ObjectiveSettings
from improvo.geometry import se3
from improvo.types import Float64

SOURCE = Path(__file__).parent / "ceres"


class CeresMissingError(RuntimeError):
    """CMake, a C++ compiler or Ceres is not installed."""


@dataclass(frozen=True)
class CeresResult:
    """What the program printed and wrote; `cost` is Omega, without Ceres' factor of one half."""

    cam_from_world: Float64
    points: Float64
    cost: float
    initial_cost: float
    iterations: int
    rejected: int
    converged: bool
    threads: int
    version: str
    seconds: float  # processor time of the iterations alone: no building, no preprocessing, no first evaluation
    preprocess: float  # wall clock, as Ceres measures it
    parts: dict[str, float]  # wall clock, as Ceres measures them


def build(folder: Path) -> Path:
    """Configure and compile into `folder` (quick where nothing changed); the path of the program.

    Raises:
        CeresMissingError: with the line that mends it.
    """
    if shutil.which("cmake") is None:
        raise CeresMissingError("needs CMake and Ceres: apt-get install cmake g++ libceres-dev")
    steps = [["cmake", "-S", str(SOURCE), "-B", str(folder)], ["cmake", "--build", str(folder)]]
    for step in steps:
        done = subprocess.run(step, capture_output=True, text=True, check=False)
        if done.returncode:
            tail = " / ".join((done.stdout + done.stderr).strip().splitlines()[-3:])
            raise CeresMissingError(f"cannot build against Ceres (apt-get install g++ libceres-dev): {tail}")
    return folder / "bundle"


def solve_with_ceres(
    program: Path,
    problem: BundleProblem,
    objective: ObjectiveSettings,
    max_iterations: int = 100,
    function_tolerance: float = 1e-6,
    rows: int = 3,
    lapack: bool = False,
) -> CeresResult:
    """Solve with Ceres on one thread.

    Args:
        function_tolerance: Ceres' default is 1e-6; below it, its other two stopping rules are switched off as well.
        rows: 3 for the exact objective, 2 without the depth regulariser (see bundle.cpp).
        lapack: factorise the reduced system with LAPACK, not Eigen.
    """
    with tempfile.TemporaryDirectory() as name:
        source, target = Path(name) / "problem", Path(name) / "solution"
        with source.open("wb") as file:
            for values, dtype in _flat(problem, objective):
                np.ascontiguousarray(values, dtype).tofile(file)
        command = [str(program), str(source), str(target), str(rows), str(max_iterations), repr(function_tolerance)]
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        done = subprocess.run([*command, str(int(lapack))], capture_output=True, text=True, check=True, env=environment)
        report = json.loads(done.stdout)
        solution = np.fromfile(target)
    cameras = len(problem.cam_from_world)
    poses = solution[: 7 * cameras].reshape(-1, 7)
    return CeresResult(
        cam_from_world=se3.rigid(se3.rotation_from_quat_xyzw(poses[:, :4]), poses[:, 4:]),
        points=solution[7 * cameras :].reshape(-1, 3),
        parts={name: report[name] for name in ("residuals", "jacobians", "linear_solver")},
        **{name: report[name] for name in ("cost", "initial_cost", "iterations", "rejected", "converged")},
        **{name: report[name] for name in ("threads", "version", "seconds", "preprocess")},
    )


def _flat(problem: BundleProblem, objective: ObjectiveSettings) -> list[tuple[object, type]]:
    K = problem.K
    rotations, translations = problem.cam_from_world[:, :3, :3], problem.cam_from_world[:, :3, 3]
    constants = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], objective.huber_width]
    constants += [objective.depth_min, objective.depth_max, objective.depth_weight]
    return [
        ([len(problem.cam_from_world), len(problem.points), len(problem.camera_index)], np.int64),
        (constants, np.float64),
        (np.hstack([se3.quat_xyzw_from_rotation(rotations), translations]), np.float64),
        (problem.points, np.float64),
        (problem.camera_index, np.int64),
        (problem.point_index, np.int64),
        (problem.keypoints, np.float64),
        (problem.weights, np.float64),
        (problem.fixed_cameras, np.int64),
    ]
