"""Scale by the height of the camera over the ground.

The ground is the plane below the camera that most points of the map lie on and hardly any beneath. Which way is down is
guessed from the plane itself: its normal must only be within some degrees of the picture's own downward direction. The
plane is fitted anew along the way, so that hills and a changing scale show.
"""

from __future__ import annotations

import numpy as np

from improvo.errors import InputError
from improvo.odometry.scale.estimate import ScaleEstimate, from_measurements, robust_spread
from improvo.odometry.scale.settings import ScaleSettings
from improvo.odometry.scale.tracked import TrackedRun
from improvo.types import Float64, Int64

_BLOCK = 20  # frames that one plane is fitted to
_TRIALS = 600
_THICKNESS = 0.06  # of the camera's height: points this near the plane lie on it
_MAX_TILT_DEG = 40.0  # between the plane's normal and the picture's downward direction
_REACH = 15.0  # heights along the ground; points beyond are not exact enough
_LEAST_POINTS = 25  # on the plane
_LEAST_PEAK = 0.65  # of the points three times as near are on the plane; a third would be by chance
_LEAST_ACROSS = 0.12  # of the camera's height: how far the points on the plane spread in their narrower direction
_LEAST_BLOCKS = 1 / 3  # of a segment in which the ground is seen
_MOST_BENEATH = 0.3  # of the points on the plane
_MOST_SPREAD = 0.25  # between the blocks of a segment, and from its first to its last third


def scale_from_height(run: TrackedRun, settings: ScaleSettings, seed: int = 0) -> dict[int, ScaleEstimate]:
    """By segment, where a ground was found.

    Args:
        run: finished.
        settings: with the camera's height.
        seed: of the random samples.

    Raises:
        InputError: no ground in any segment, or heights that contradict each other.
    """
    assert settings.metres is not None
    found = {}
    for segment in run.segments:
        frames = run.frames(segment)
        heights, places = [], []
        blocks = np.array_split(frames, max(1, round(len(frames) / _BLOCK)))
        for block in blocks:
            height = _height(run, block, np.random.default_rng([seed, int(block[0])]))
            if height is not None:
                heights.append(height)
                places.append(float(block.mean()))
        if len(heights) < _LEAST_BLOCKS * len(blocks):
            continue
        factors = settings.metres / np.array(heights)
        found[segment] = from_measurements(factors, np.array(places))
        spread = max(robust_spread(factors) / float(np.median(factors)), abs(found[segment].change or 0.0))
        if spread > _MOST_SPREAD:
            raise InputError(
                f"--scale height: contradicts itself, the height over the ground differs by {100 * spread:.0f} % along "
                "the way; it must be the same all along, over even ground that is seen all the time"
            )
    if not found:
        raise InputError(
            "--scale height: no ground was found among the points of the map, or too rarely; the camera must see it, "
            "with texture, below the middle of the picture"
        )
    return found


def _height(run: TrackedRun, frames: Int64, rng: np.random.Generator) -> float | None:
    """Median height of the frames' cameras over the ground that they see, in units of the run; None without one."""
    rows = np.concatenate([np.arange(*run.seen_by(int(frame)).indices(len(run.known.frame))) for frame in frames])
    points = np.unique(run.known.xyz[rows], axis=0)
    centres = run.trajectory.camera_centers[frames]
    down = run.trajectory.world_from_cam[frames, :3, 1].mean(axis=0)
    down /= np.linalg.norm(down)
    plane = ground_plane(points, centres, down, rng)
    return None if plane is None else float(np.median(plane[1] - centres @ plane[0]))


def ground_plane(
    points: Float64, centres: Float64, down: Float64, rng: np.random.Generator
) -> tuple[Float64, float] | None:
    """Unit normal n (3,) that points down and offset d of the ground n·x = d; None where there is none.

    Args:
        points: (P, 3) of the map.
        centres: (N, 3) of the cameras.
        down: (3,) unit vector, about downwards.
        rng: for the samples.
    """
    middle = centres.mean(axis=0)
    below = points[(points - middle) @ down > 0]
    if len(below) < _LEAST_POINTS:
        return None
    best: tuple[float, Float64, float] = (0.0, down, 0.0)
    least_cosine = np.cos(np.radians(_MAX_TILT_DEG))
    for _ in range(_TRIALS):
        a, b, c = below[rng.choice(len(below), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 1e-12:
            continue
        normal *= np.sign(normal @ down) / length
        if normal @ down < least_cosine:
            continue
        score = _score(below, middle, normal, float(normal @ a))
        if score > best[0]:
            best = (score, normal, float(normal @ a))
    if best[0] < _LEAST_POINTS:
        return None
    normal, offset = best[1], best[2]
    for _ in range(3):
        on = _on_ground(below, middle, normal, offset)[0]
        if on.sum() < _LEAST_POINTS:
            return None
        mean = below[on].mean(axis=0)
        normal = np.linalg.svd(below[on] - mean, full_matrices=False)[2][2]
        normal = normal * np.sign(normal @ down)
        offset = float(normal @ mean)
    on, beneath = _on_ground(below, middle, normal, offset)
    about = _on_ground(below, middle, normal, offset, 3 * _THICKNESS)[0]
    across = np.linalg.svd(below[on] - below[on].mean(axis=0), compute_uv=False)[1] / np.sqrt(max(on.sum(), 1))
    clear = on.sum() >= max(_LEAST_POINTS, _LEAST_PEAK * about.sum()) and beneath.sum() <= _MOST_BENEATH * on.sum()
    clear &= across >= _LEAST_ACROSS * (offset - float(normal @ middle))
    return (normal, offset) if clear and offset > float((centres @ normal).max()) else None


def _on_ground(
    points: Float64, middle: Float64, normal: Float64, offset: float, thickness: float = _THICKNESS
) -> tuple[np.ndarray, np.ndarray]:
    """(P,) which points lie on the plane, and which clearly beneath it; those too far away are neither."""
    height = offset - float(normal @ middle)
    if height <= 0:
        nothing = np.zeros(len(points), np.bool_)
        return nothing, nothing
    depth = points @ normal - offset
    along = np.linalg.norm(points - middle, axis=1)
    near = along < _REACH * height
    return near & (np.abs(depth) < thickness * height), near & (depth > 3 * _THICKNESS * height)


def _score(points: Float64, middle: Float64, normal: Float64, offset: float) -> float:
    on, beneath = _on_ground(points, middle, normal, offset)
    return float(on.sum() - 2 * beneath.sum())
