"""Does a camera that only turns explain a window as well as the map does, if its focal length may be another?

A telephoto lens that pans moves the picture almost as a wide one does that moves along a wall: all points then lie on
one plane, and no point says which of the two it was. Where the focal length is a guess, the map proves nothing there.
With the right focal length, the start of a map refuses turns by itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from improvo.geometry.camera import Camera
from improvo.geometry.se3 import so3_exp
from improvo.odometry.verdict.evidence_window import EvidenceWindow
from improvo.types import Float64, Int64

_KEYFRAMES = 6  # of a window, evenly; more say the same
_POINTS = 300  # likewise
_FEW = 40  # points; fewer say nothing
_STARTS = (0.0, np.log(2.5))  # of the logarithm of the focal length over that of the guess
_ITERATIONS = 12
_HUBER = 2.0  # pixels
_STEP = 1e-5  # of the numerical derivative


@dataclass(frozen=True)
class TurningCamera:
    """A camera that only turns, with the focal length that suits it best, in one window.

    Attributes:
        error_px: median distance of the keypoints from where it has them.
        map_px: the same of the map.
        fov: its field of view, degrees across the picture.
        moved: by how much the points move in the window, median, share of the picture's width.
    """

    error_px: float
    map_px: float
    fov: float
    moved: float


def turning_camera(window: EvidenceWindow, camera: Camera) -> TurningCamera | None:
    """The best turns and focal length of a window; None where it has too few points.

    Args:
        window: of several keyframes.
        camera: as given.
    """
    chosen = np.unique(np.linspace(0, len(window) - 1, _KEYFRAMES).astype(np.int64))
    seen = np.isin(window.camera, chosen)
    seen = window.seen_at_least(max(2, len(chosen) // 2), seen)
    points = np.unique(window.point[seen])
    if len(points) < _FEW:
        return None
    seen &= np.isin(window.point, points[np.unique(np.linspace(0, len(points) - 1, _POINTS).astype(np.int64))])
    turn = np.searchsorted(chosen, window.camera[seen])
    point = np.unique(window.point[seen], return_inverse=True)[1].astype(np.int64)
    pixels = window.keypoints[seen]
    error_px, focal_ratio = min(_fitted(turn, point, pixels, camera, start) for start in _STARTS)
    residuals, rows = window.residuals(camera)
    of_map = np.linalg.norm(residuals[seen[rows]], axis=1)
    lowest, highest = np.full((point.max() + 1, 2), np.inf), np.full((point.max() + 1, 2), -np.inf)
    np.minimum.at(lowest, point, pixels)
    np.maximum.at(highest, point, pixels)
    moved = float(np.median((highest - lowest).max(axis=1))) / camera.width
    fov = float(np.degrees(2 * np.arctan(0.5 * camera.width / (camera.fx * focal_ratio))))
    return TurningCamera(error_px, float(np.median(of_map)) if len(of_map) else 0.0, fov, moved)


def _fitted(turn: Int64, point: Int64, pixels: Float64, camera: Camera, start: float) -> tuple[float, float]:
    """Median error in pixels and focal ratio of a Levenberg-Marquardt descent from a focal length and no turn.

    The direction of a point is the mean of what the keyframes see of it, so that only turns and focal length are free.
    """
    values = np.zeros(1 + 3 * int(turn.max()))
    values[0] = start
    off = pixels - (camera.cx, camera.cy)

    def residuals(values: Float64) -> Float64:
        focal = np.array((camera.fx, camera.fy)) * np.exp(values[0])
        turns = np.stack([np.eye(3), *(so3_exp(each) for each in values[1:].reshape(-1, 3))])
        rays = np.column_stack([off / focal, np.ones(len(off))])
        world = np.einsum("oji,oj->oi", turns[turn], rays)
        world /= np.linalg.norm(world, axis=1, keepdims=True)
        mean = np.stack([np.bincount(point, axis) for axis in world.T], axis=1)
        seen = np.einsum("oij,oj->oi", turns[turn], mean[point])
        return np.asarray(focal * seen[:, :2] / seen[:, 2:] - off, np.float64)

    def cost(residual: Float64) -> float:
        distance = np.linalg.norm(residual, axis=1)
        robust = np.where(distance < _HUBER, distance**2, _HUBER * (2 * distance - _HUBER))
        return float(robust.sum()) if np.isfinite(distance).all() else np.inf

    here, damping = residuals(values), 1e-4
    lowest = cost(here)
    for _ in range(_ITERATIONS):
        root = np.sqrt(np.minimum(1.0, _HUBER / np.maximum(np.linalg.norm(here, axis=1), 1e-9)))[:, None]
        columns = [((residuals(values + step) - here) * root / _STEP).ravel() for step in _STEP * np.eye(len(values))]
        jacobian = np.stack(columns, axis=1)
        normal, gradient = jacobian.T @ jacobian, jacobian.T @ (here * root).ravel()
        before = lowest
        while damping < 1e4:
            tried = values - np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-9), gradient)
            there = residuals(tried)
            if (found := cost(there)) < lowest:
                values, here, lowest, damping = tried, there, found, max(damping / 10, 1e-7)
                break
            damping *= 10
        if before - lowest <= 1e-4 * before:
            break
    return float(np.median(np.linalg.norm(here, axis=1))), float(np.exp(values[0]))
