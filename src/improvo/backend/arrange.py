"""Prepares a problem for the kernels: sorts observations by point, numbers free cameras, allocates memory once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from improvo.backend.problem import BundleProblem
from improvo.backend.settings import ObjectiveSettings
from improvo.compiled import compiled
from improvo.types import Float64, Int64

POSE = 6  # parameters of a pose
COLUMN = 8  # numbers that a camera takes in a row of the reduced system: six, padded to whole vector registers
CHUNK = 32  # cameras in a piece of such a row
STRIDE = CHUNK * COLUMN + 8  # from a row to the next; known to the compiler, and no power of two, for the cache's sake


class Constants(NamedTuple):
    """Numbers of the objective that every kernel needs."""

    fx: float
    fy: float
    cx: float
    cy: float
    huber_width: float
    depth_min: float
    depth_max: float
    depth_weight: float


class Observations(NamedTuple):
    """Observations sorted by point; within a point the free cameras first, in rising order, then the fixed ones."""

    order: Int64  # (O,) row in the caller's problem
    camera: Int64  # (O,) row of the poses
    free_camera: Int64  # (O,) number among the free cameras, or their count for a fixed camera
    keypoints: Float64  # (O, 2) pixels
    weights: Float64  # (O,)
    first: Int64  # (M + 1,) the observations of point j are first[j]:first[j + 1]
    first_fixed: Int64  # (M,) and those from here on are by fixed cameras
    first_of_camera: Int64  # (O,) the first observation of this point by this camera: itself, unless it saw it twice
    run_end: Int64  # (O,) end of the consecutive cameras, within a chunk, that start here
    point_order: Int64  # (M,) the points by the first free camera that saw them: neighbours share cached rows
    point_is_free: NDArray[np.bool_]  # (M,)
    camera_of_free: Int64  # (F,) row of the poses of each free camera


class System(NamedTuple):
    """The linearised problem and the reduced system; every array is filled anew in each iteration."""

    in_camera: Float64  # (O, 3) R X + t
    coupling: Float64  # (O, 3, 3) A R, with A the Hessian of the observation in the camera's frame
    camera_hessian: Float64  # (F, 6, 6) upper triangles
    camera_gradient: Float64  # (F, 6)
    point_hessian: Float64  # (M, 6) xx, xy, xz, yy, yz, zz
    point_gradient: Float64  # (M, 3)
    point_root: Float64  # (M, 6) the inverse Cholesky factor of each damped point block
    point_rhs: Float64  # (M, 3) that factor times the gradient
    elimination: Float64  # (3, 8 L) of the present point: its coupling blocks times the transpose of that factor
    reduced: Float64  # flat (F, chunks, 6, STRIDE): the blocks on and above the diagonal, then their Cholesky factor
    camera_step: Float64  # (F, 6) translation, rotation
    point_step: Float64  # (M, 3)


def arrange(problem: BundleProblem, objective: ObjectiveSettings) -> tuple[Constants, Observations, System]:
    """Sort the observations and lay out the memory."""
    K = problem.K
    constants = Constants(
        float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]),
        float(objective.huber_width), float(objective.depth_min), float(objective.depth_max),
        float(objective.depth_weight),
    )  # fmt: skip
    camera_of_free = np.flatnonzero(~np.asarray(problem.fixed_cameras, np.bool_)).astype(np.int64)
    free = len(camera_of_free)
    free_number = np.full(len(problem.cam_from_world), free, np.int64)
    free_number[camera_of_free] = np.arange(free)
    camera_index = np.ascontiguousarray(problem.camera_index, np.int64)
    point_index = np.ascontiguousarray(problem.point_index, np.int64)
    order, first, first_fixed = sort_observations(free_number[camera_index], point_index, free, len(problem.points))
    free_camera = free_number[camera_index[order]]
    first_of_camera, run_end = find_runs(free_camera, first, first_fixed)
    first_camera = np.append(free_camera, free)[np.where(first_fixed > first[:-1], first[:-1], len(order))]
    observations = Observations(
        order,
        camera_index[order],
        free_camera,
        np.ascontiguousarray(problem.keypoints[order], np.float64),
        np.ascontiguousarray(problem.weights[order], np.float64),
        first,
        first_fixed,
        first_of_camera,
        run_end,
        np.argsort(first_camera, kind="stable"),
        problem.free_points,
        camera_of_free,
    )
    return (
        constants,
        observations,
        _allocate(len(order), len(problem.points), free, int((first_fixed - first[:-1]).max(initial=0))),
    )


def _allocate(observations: int, points: int, free: int, longest: int) -> System:
    return System(
        in_camera=np.zeros((observations, 3)),
        coupling=np.zeros((observations, 3, 3)),
        camera_hessian=np.zeros((free, POSE, POSE)),
        camera_gradient=np.zeros((free, POSE)),
        point_hessian=np.zeros((points, 6)),
        point_gradient=np.zeros((points, 3)),
        point_root=np.zeros((points, 6)),
        point_rhs=np.zeros((points, 3)),
        elimination=_aligned(3 * COLUMN * longest).reshape(3, -1),
        reduced=_aligned(free * -(-free // CHUNK) * POSE * STRIDE),
        camera_step=np.zeros((free, POSE)),
        point_step=np.zeros((points, 3)),
    )


def _aligned(count: int) -> Float64:
    """Zeros that start on a cache line, which whole vector registers are read from fastest."""
    memory = np.zeros(count + 8)
    start = -(memory.ctypes.data // 8) % 8
    return memory[start : start + count]


@compiled
def sort_observations(free_camera, point, free, points):  # type: ignore[no-untyped-def]
    """Counting sort by camera, then a stable one by point: `order`, `first` and `first_fixed` of `Observations`."""
    observations = len(point)
    by_camera = np.empty(observations, np.int64)
    slot = np.zeros(free + 2, np.int64)
    for row in range(observations):
        slot[free_camera[row] + 1] += 1
    for camera in range(free + 1):
        slot[camera + 1] += slot[camera]
    for row in range(observations):
        by_camera[slot[free_camera[row]]] = row
        slot[free_camera[row]] += 1

    first = np.zeros(points + 1, np.int64)
    for row in range(observations):
        first[point[row] + 1] += 1
    for j in range(points):
        first[j + 1] += first[j]
    order = np.empty(observations, np.int64)
    slot = first[:points].copy()
    first_fixed = first[:points].copy()
    for k in range(observations):
        row = by_camera[k]
        j = point[row]
        order[slot[j]] = row
        slot[j] += 1
        if free_camera[row] < free:
            first_fixed[j] += 1
    return order, first, first_fixed


@compiled
def find_runs(free_camera, first, first_fixed):  # type: ignore[no-untyped-def]
    """`first_of_camera` and `run_end` of `Observations`."""
    first_of_camera, run_end = np.arange(len(free_camera)), np.arange(1, len(free_camera) + 1)
    for j in range(len(first_fixed)):
        for k in range(first[j] + 1, first_fixed[j]):
            if free_camera[k] == free_camera[k - 1]:
                first_of_camera[k] = first_of_camera[k - 1]
        for k in range(first_fixed[j] - 2, first[j] - 1, -1):
            if free_camera[k + 1] == free_camera[k] + 1 and free_camera[k + 1] % CHUNK != 0:
                run_end[k] = run_end[k + 1]
    return first_of_camera, run_end
