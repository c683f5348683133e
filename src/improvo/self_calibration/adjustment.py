"""Bundle adjustment of views, points and the one lens that all views share.

The objective is that of the paper, Σ ρ(e²), with the lens among the unknowns and Cauchy's ρ. Each point is eliminated
from the normal equations (Schur complement); what remains are the views and the lens.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from improvo.geometry import se3
from improvo.self_calibration.elimination import back_substitute, eliminate
from improvo.self_calibration.lens import Lens
from improvo.types import Float64, Int64, Mask

LOSS_WIDTH = 0.25  # pixels, of Cauchy's loss: below the noise, so that points that drift along an edge count little
_FITS = 3.0  # pixels, of observations that are no outliers
_ITERATIONS, _RELATIVE_DECREASE = 60, 1e-7
# What is known of any lens before a picture is seen: pixels are square, the middle of the picture is near the optical
# axis, and coefficients are small.
SQUARE = 0.003  # standard deviation of fy / fx
CENTRED = 0.05  # of the principal point, as a share of the width
SMALL = (0.5, 0.5)  # of k1, k2
READOUT = 0.02  # seconds, of the read-out of a picture


@dataclass(frozen=True)
class Scene:
    """Views of points by one lens; observations are sorted by point."""

    lens: Lens
    cam_from_world: Float64  # (V, 4, 4)
    xyz: Float64  # (P, 3)
    view: Int64  # (M,)
    point: Int64  # (M,)
    pixels: Float64  # (M, 2) as recorded, distorted
    world: Int64  # (V,) those of another world share no point, and have a scale of their own
    motion: Float64  # (V, 6) how points move in the camera's frame as it moves: shift and turn, a second
    readout: float = 0.0  # seconds between the first and the last row of a picture (rolling shutter)

    def errors(self) -> Float64:
        """Re-projection errors (M,) in pixels; infinite behind a camera."""
        errors = np.linalg.norm(_residuals(self)[0], axis=1)
        return np.where(np.isfinite(errors), errors, np.inf)

    def kept(self, drop: Mask, min_views: int = 3) -> Mask:
        """Which observations (M,) are left without these, and without points that too few views are left of."""
        keep = ~drop
        count = np.bincount(self.point[keep], minlength=len(self.xyz))
        return np.asarray(keep & (count >= min_views)[self.point])

    def only(self, keep: Mask) -> Scene:
        """With these observations (M,) alone, and the points that they see."""
        used, point = np.unique(self.point[keep], return_inverse=True)
        return replace(self, xyz=self.xyz[used], view=self.view[keep], point=point, pixels=self.pixels[keep])


@dataclass(frozen=True)
class Adjusted:
    """An adjusted scene, and how sure the lens is."""

    scene: Scene
    cost: float
    rms: float  # pixels, of the observations that fit (within 3)
    covariance: Float64  # (7, 7) of the lens, and of the read-out


def adjust(scene: Scene, iterations: int = _ITERATIONS) -> Scene:
    """Levenberg-Marquardt over lens, views and points."""
    first = _first_of_points(scene)
    cost, damping = _cost(scene), 1e-4
    for _ in range(iterations):
        system = _linearised(scene, first)
        improved = False
        while damping < 1e8:
            candidate = _stepped(scene, system, first, damping)
            new = _cost(candidate) if candidate is not None else np.inf
            if new < cost:
                improved = True
                break
            damping = max(damping, 1e-8) * 10.0
        if not improved or candidate is None:
            break
        decrease, cost, scene = (cost - new) / cost, new, candidate
        damping = max(damping / 5.0, 1e-8)
        if decrease < _RELATIVE_DECREASE:
            break
    return scene


def adjusted(scene: Scene, iterations: int = _ITERATIONS) -> Adjusted:
    """`adjust`, and the covariance of the lens (see `covariance`)."""
    scene = adjust(scene, iterations)
    errors = scene.errors()
    fits = errors < _FITS
    rms = float(np.sqrt((errors[fits] ** 2).mean())) if fits.any() else float("inf")
    return Adjusted(scene, _cost(scene), rms, covariance(scene))


def covariance(scene: Scene) -> Float64:
    """(7, 7) of lens and read-out from the normal equations, with views and points unknown too.

    The errors of one point are alike in neighbouring views, and those of one view are alike where it is blurred or was
    read out while the camera turned. So neither count as independent: the middle of the sandwich has the sums over each
    point and over each view (cluster-robust in two ways; Cameron, Gelbach and Miller 2011). The plain covariance, the
    inverse times the variance of the residuals, is the least that it can be.
    """
    first = _first_of_points(scene)
    system = _linearised(scene, first)
    by_pose, by_value, by_point, residuals, weights = system
    views = len(scene.cam_from_world)
    reduced, _, inverses, _ = eliminate(scene.view, first, *system, views, 0.0)
    size = 6 * views
    poses = reduced[:size, :size] + _held_scale(scene, reduced)
    # the world may lie anywhere, and a view may have lost all its observations: the lens does not depend on either
    poses = poses + np.diag(1e-9 * (np.diag(poses) + np.diag(poses).mean()))
    try:
        with_lens = _solved(poses, reduced[:size, size:]).reshape(views, 6, 7)
    except (np.linalg.LinAlgError, ValueError):
        return np.full((7, 7), np.inf)
    # what a change of the lens does to each pixel after views and points have followed it as far as they can
    effect = by_value - by_pose @ with_lens[scene.view]
    pull = np.zeros((len(scene.xyz), 3, 7))
    np.add.at(pull, scene.point, weights[:, None, None] * np.swapaxes(by_point, 1, 2) @ effect)
    effect -= by_point @ (inverses @ pull)[scene.point]
    prior = _prior(scene)[0]
    information = np.einsum("mia,m,mib->ab", effect, weights, effect) + prior
    inverse = np.linalg.inv(information)
    scores = np.einsum("mia,mi->ma", effect, residuals * weights[:, None])
    middle = _summed(scores, scene.point) + _summed(scores, scene.view) - scores.T @ scores
    clustered = inverse @ (middle + prior) @ inverse
    freedom = max(2 * len(scene.view) - 3 * len(scene.xyz) - size, 1)
    plain = inverse * (float((weights * (residuals**2).sum(axis=1)).sum()) / freedom)
    scale = np.sqrt(np.maximum(np.diag(clustered), np.diag(plain)) / np.diag(plain))
    return plain * np.outer(scale, scale)


def outlier_cost(pixels: float) -> float:
    """What an observation so far off adds to the cost."""
    return float(0.5 * LOSS_WIDTH**2 * np.log1p((pixels / LOSS_WIDTH) ** 2))


def _summed(scores: Float64, group: Int64) -> Float64:
    """The sum of the outer products (7, 7) of the groups' summed scores (M, 7)."""
    sums = np.zeros((int(group.max()) + 1, scores.shape[1]))
    np.add.at(sums, group, scores)
    return sums.T @ sums


def _first_of_points(scene: Scene) -> Int64:
    """(P + 1,) where the observations of each point begin."""
    return np.searchsorted(scene.point, np.arange(len(scene.xyz) + 1)).astype(np.int64)


def _residuals(scene: Scene) -> tuple[Float64, Float64, Float64, Float64]:
    """Residuals (M, 2); points in the cameras (M, 3); derivatives by them (M, 2, 3), by lens and read-out (M, 2, 7)."""
    rotation, shift = scene.cam_from_world[:, :3, :3], scene.cam_from_world[:, :3, 3]
    points_cam = np.einsum("mij,mj->mi", rotation[scene.view], scene.xyz[scene.point]) + shift[scene.view]
    # a row is read out while the camera moves on; the middle row has the pose of the view
    when = (scene.pixels[:, 1] - (scene.lens.height - 1) / 2) / scene.lens.height
    motion = scene.motion[scene.view]
    moves = when[:, None] * (motion[:, :3] + np.cross(motion[:, 3:], points_cam))
    pixels, by_point, by_lens = scene.lens.project(points_cam + scene.readout * moves)
    by_readout = by_point @ moves[..., None]
    turned = np.cross(by_point, motion[:, None, 3:])
    by_point = by_point + scene.readout * when[:, None, None] * turned
    return pixels - scene.pixels, points_cam, by_point, np.concatenate([by_lens, by_readout], axis=-1)


def _cost(scene: Scene) -> float:
    """The objective; an observation behind the camera costs as if it were far off."""
    squared = (_residuals(scene)[0] ** 2).sum(axis=1)
    squared = np.where(np.isfinite(squared), squared, 1e6)
    cost = _prior(scene)[2]
    return float(0.5 * LOSS_WIDTH**2 * np.log1p(squared / LOSS_WIDTH**2).sum()) + cost


def _linearised(scene: Scene, first: Int64) -> tuple[Float64, Float64, Float64, Float64, Float64]:
    """Derivatives of the residuals by pose (M, 2, 6), lens (M, 2, 7), point (M, 2, 3); residuals; weights (M,)."""
    residuals, points_cam, by_point_cam, by_value = _residuals(scene)
    rotation = scene.cam_from_world[:, :3, :3]
    by_point = by_point_cam @ rotation[scene.view]
    by_pose = np.concatenate([by_point_cam, np.cross(points_cam[:, None], by_point_cam)], axis=-1)
    weights = 1.0 / (1.0 + (residuals**2).sum(axis=1) / LOSS_WIDTH**2)
    behind = ~np.isfinite(weights)
    for array in (by_pose, by_value, by_point, residuals):
        array[behind] = 0.0
    weights[behind] = 0.0
    return by_pose, by_value, by_point, residuals, weights


def _prior(scene: Scene) -> tuple[Float64, Float64, float]:
    """Information (7, 7), gradient (7,) and cost of what is known of any camera."""
    lens = scene.lens
    fx, fy, cx, cy, k1, k2 = lens.values
    rows = np.zeros((6, 7))
    rows[0, 0], rows[0, 1] = -fy / fx**2 / SQUARE, 1.0 / fx / SQUARE
    rows[1, 2] = rows[2, 3] = 1.0 / (CENTRED * lens.width)
    rows[3, 4], rows[4, 5] = 1.0 / SMALL[0], 1.0 / SMALL[1]
    rows[5, 6] = 1.0 / READOUT
    middle = (lens.width - 1) / 2, (lens.height - 1) / 2
    off = np.array(
        [
            (fy / fx - 1.0) / SQUARE,
            (cx - middle[0]) / (CENTRED * lens.width),
            (cy - middle[1]) / (CENTRED * lens.width),
            k1 / SMALL[0],
            k2 / SMALL[1],
            scene.readout / READOUT,
        ]
    )
    return rows.T @ rows, rows.T @ off, 0.5 * float(off @ off)


def _solved(matrix: Float64, right: Float64) -> Float64:
    """The solution of symmetric equations.

    Raises:
        np.linalg.LinAlgError: the matrix is not positive definite.
    """
    if not np.isfinite(matrix).all():
        raise np.linalg.LinAlgError("not finite")
    np.linalg.cholesky(matrix)  # raises
    return np.asarray(np.linalg.solve(matrix, right), np.float64)


def _held_scale(scene: Scene, reduced: Float64) -> Float64:
    """What holds the scale of each world, (6 V, 6 V): the speed in `motion` is in the unit that the odometry chose."""
    shifts = np.zeros((len(scene.world), 6))
    shifts[:, :3] = scene.cam_from_world[:, :3, 3]
    worlds = np.unique(scene.world)
    directions = np.where(scene.world[:, None, None] == worlds, shifts[:, :, None], 0.0).reshape(-1, len(worlds))
    directions /= np.maximum(np.linalg.norm(directions, axis=0), 1e-12)
    return float(np.diag(reduced)[: len(directions)].mean()) * directions @ directions.T


def _stepped(scene: Scene, system: tuple[Float64, ...], first: Int64, damping: float) -> Scene | None:
    """The scene after a damped step; None where the equations cannot be solved."""
    views = len(scene.cam_from_world)
    reduced, right, inverses, couplings = eliminate(scene.view, first, *system, views, damping)
    information, gradient, _ = _prior(scene)
    reduced[6 * views :, 6 * views :] += information
    right[6 * views :] -= gradient
    reduced[: 6 * views, : 6 * views] += _held_scale(scene, reduced)
    diagonal = np.diag(reduced).copy()
    reduced[np.diag_indices_from(reduced)] += damping * diagonal + 1e-12
    try:
        step = _solved(reduced, right)
    except (np.linalg.LinAlgError, ValueError):
        return None
    if not np.isfinite(step).all():
        return None
    xyz = scene.xyz + back_substitute(scene.view, first, *system, inverses, couplings, step)
    values = scene.lens.values + step[6 * views : -1]
    if min(values[:2]) < 0.05 * scene.lens.width or max(values[:2]) > 20.0 * scene.lens.width:
        return None
    moves = step[: 6 * views].reshape(views, 6)
    turned = se3.rigid(se3.so3_exp(moves[:, 3:]), moves[:, :3])
    return replace(
        scene,
        lens=replace(scene.lens, values=values),
        cam_from_world=turned @ scene.cam_from_world,
        xyz=xyz,
        readout=scene.readout + float(step[-1]),
    )
