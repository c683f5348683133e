"""A camera from views of a board (Zhang 2000, through OpenCV), or a plain word on why these views cannot give one."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from improvo.calibration.board import Board, homography_tilt
from improvo.errors import InputError
from improvo.geometry.camera import Camera
from improvo.types import Float32, Float64, UInt8

MODELS = ("auto", "brown4", "brown5", "brown8", "fisheye")
MIN_VIEWS = 6
MAX_RMS = 1.5  # pixels
MIN_COVERAGE = 0.35  # of the picture's cells
MAX_FOCAL_DEVIATION = 0.01  # of the focal length
MIN_TILT = 8.0  # degrees between the board and the picture, in the view that is tilted most
_CELLS = (8, 6)
_SHARP = 0.75  # of the median sharpness
_SIMPLER = 0.97  # a richer model must bring the error below this share of the simpler one's
_OUTLIER = 3.0  # times the median error of the views
_FISHEYE_STARTS = (90.0, 120.0, 150.0, 180.0)  # degrees
_CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-9)


@dataclass(frozen=True)
class View:
    """One picture of the board."""

    source: str
    points: Float32  # (N, 3) metres on the board
    pixels: Float32  # (N, 2)
    sharpness: float  # larger is sharper
    pose: Float64  # (5,) see `homography_tilt`


@dataclass(frozen=True)
class CameraFit:
    """A calibrated camera and how sure it is."""

    camera: Camera
    model: str
    rms: float  # pixels, over all corners
    deviations: dict[str, float]  # parameter -> standard deviation
    views: tuple[View, ...]  # those that were used
    view_errors: Float64  # (V,) pixels, RMS of each view
    coverage: Float64  # (6, 8) corners in each cell of the picture
    tried: dict[str, float]  # model -> RMS


def find_views(
    board: Board, pictures: Iterable[tuple[str, UInt8]], progress: Callable[[bool], object] = lambda _: None
) -> list[View]:
    """The board in each grey picture that shows it.

    Args:
        board: what to look for.
        pictures: source and picture (H, W).
        progress: called after each with whether the board was found.
    """
    views = []
    for source, image in pictures:
        found = board.find(image)
        if found is not None:
            points, pixels = found
            pose = homography_tilt(points, pixels, (image.shape[1], image.shape[0]))
            views.append(View(source, points, pixels, _sharpness(image, pixels), pose))
        progress(found is not None)
    return views


def choose_views(views: list[View], count: int) -> list[View]:
    """Sharp views that differ: blurred ones are left out, then always the view farthest from those chosen is taken."""
    if len(views) <= MIN_VIEWS:
        return views
    least = _SHARP * float(np.median([view.sharpness for view in views]))
    sharp = [view for view in views if view.sharpness >= least]
    poses = np.stack([view.pose for view in sharp])
    distance = np.linalg.norm(poses - np.median(poses, axis=0), axis=1)
    chosen: list[int] = []
    nearest = np.full(len(sharp), np.inf)
    while len(chosen) < min(count, len(sharp)):
        row = int(np.argmax(np.minimum(nearest, distance) if not chosen else nearest))
        chosen.append(row)
        nearest = np.minimum(nearest, np.linalg.norm(poses - poses[row], axis=1))
        if nearest.max() < 0.01:
            break  # what is left repeats a view that is there
    return [sharp[row] for row in sorted(chosen)]


def fit_camera(views: list[View], size: tuple[int, int], model: str = "auto") -> CameraFit:
    """Calibrate.

    Args:
        views: of one board.
        size: width, height of the pictures.
        model: one of `MODELS`; `auto` takes a richer one only where it explains the corners clearly better.

    Raises:
        InputError: too few views, or a set that leaves the camera undetermined; says what is missing.
    """
    if len(views) < MIN_VIEWS:
        raise InputError(
            f"the board was found in {len(views)} different sharp views, {MIN_VIEWS} are needed; "
            "check --board, and show it larger, from many sides and at rest"
        )
    coverage = _coverage(views, size)
    share = float((coverage > 0).mean())
    if share < MIN_COVERAGE:
        raise InputError(
            f"the board covers only {100 * share:.0f} % of the picture ({_missing(coverage)} is empty); "
            "move it through the whole picture, into the corners too"
        )
    names = ("brown4", "brown5", "fisheye") if model == "auto" else (model,)
    fits = _solve(views, size, names)
    if not fits:
        raise InputError("no camera explains these views of the board; check the corner count of --board")
    simplest = next(iter(fits))
    best = min(fits, key=lambda name: fits[name].rms)
    best = best if fits[best].rms < _SIMPLER * fits[simplest].rms else simplest
    fit = fits[best]
    _refuse_undetermined(fit)
    tried = {name: one.rms for name, one in fits.items()}
    return CameraFit(fit.camera, best, fit.rms, fit.deviations, fit.views, fit.view_errors, coverage, tried)


@dataclass(frozen=True)
class _Solved:
    camera: Camera
    rms: float
    deviations: dict[str, float]
    views: tuple[View, ...]
    view_errors: Float64
    tilt: float  # degrees, of the view that is tilted most


def _solve(views: list[View], size: tuple[int, int], names: tuple[str, ...]) -> dict[str, _Solved]:
    """Calibrate by every model twice: the second time without views whose error stands out.

    They stand out under the model that fits most views best, and are left out for all: a model that is too simple would
    otherwise leave out the rim of the picture, which tells it from the right one.
    """
    fits = {name: fit for name in names if (fit := _solve_once(views, size, name)) is not None}
    if not fits:
        return fits
    errors = min((fit.view_errors for fit in fits.values()), key=lambda each: float(np.median(each)))
    limit = max(_OUTLIER * float(np.median(errors)), 0.1)
    kept = [view for view, error in zip(views, errors, strict=True) if error <= limit]
    if not MIN_VIEWS <= len(kept) < len(views):
        return fits
    again = {name: _solve_once(kept, size, name, fit.camera) for name, fit in fits.items()}
    return {name: fit for name, fit in again.items() if fit is not None} or fits


def _solve_once(views: list[View], size: tuple[int, int], model: str, before: Camera | None = None) -> _Solved | None:
    """The camera of one model; `before` is that of nearly the same views."""
    if model == "fisheye":
        return _solve_fisheye(views, size, before)
    points, pixels = [view.points for view in views], [view.pixels for view in views]
    flags = {"brown4": cv2.CALIB_FIX_K3, "brown5": 0, "brown8": cv2.CALIB_RATIONAL_MODEL}[model]
    try:
        rms, matrix, distortion, rotations, _, deviations, _, errors = cv2.calibrateCameraExtended(
            points, pixels, size, None, None, flags=flags, criteria=_CRITERIA
        )
    except cv2.error:
        return None
    if not np.isfinite(matrix).all() or not np.isfinite(rms):
        return None
    count = int(model[-1])
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")[: 4 + count]
    camera = _camera(size, matrix, tuple(float(value) for value in distortion.ravel()[:count]), "brown")
    spread = dict(zip(names, deviations.ravel().tolist(), strict=False))
    return _Solved(camera, float(rms), spread, tuple(views), errors.ravel(), _tilt(rotations))


def _solve_fisheye(views: list[View], size: tuple[int, int], before: Camera | None) -> _Solved | None:
    points = [view.points.reshape(1, -1, 3).astype(np.float64) for view in views]
    pixels = [view.pixels.reshape(1, -1, 2).astype(np.float64) for view in views]
    found = _calibrated_fisheye(points, pixels, size, before)
    if found is None or found[0] > MAX_RMS:  # OpenCV's own start gives up or ends anywhere, for views at the rim
        tried = [
            found,
            *(_calibrated_fisheye(points, pixels, size, _equidistant(fov, size)) for fov in _FISHEYE_STARTS),
        ]
        found = min((each for each in tried if each is not None), key=lambda each: each[0], default=None)
    if found is None:
        return None
    rms, matrix, distortion, rotations, translations = found
    errors, rows = [], []
    coefficients = np.concatenate([matrix[[0, 1, 0, 1], [0, 1, 2, 2]], distortion.ravel()])
    for p, q, rotation, translation in zip(points, pixels, rotations, translations, strict=True):
        projected, jacobian = cv2.fisheye.projectPoints(p, rotation, translation, matrix, distortion)
        errors.append(float(np.sqrt(((projected - q) ** 2).sum(axis=-1).mean())))
        rows.append(np.delete(jacobian, 14, axis=1))  # without the skew
    spread = _fisheye_deviations(rows, float(rms))
    deviations = dict(zip(("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"), spread.tolist(), strict=True))
    if not (coefficients[:2] > 0).all():
        return None
    camera = _camera(size, matrix, tuple(float(value) for value in distortion.ravel()), "fisheye")
    return _Solved(camera, float(rms), deviations, tuple(views), np.array(errors), _tilt(rotations))


def _calibrated_fisheye(
    points: list[Float64], pixels: list[Float64], size: tuple[int, int], start: Camera | None
) -> Any:
    """RMS, K, coefficients, rotations and translations; None where OpenCV gives up."""
    flags = _fisheye_flag("CALIB_RECOMPUTE_EXTRINSIC") | _fisheye_flag("CALIB_FIX_SKEW")
    matrix, distortion = np.eye(3), np.zeros((4, 1))
    if start is not None:
        flags |= _fisheye_flag("CALIB_USE_INTRINSIC_GUESS")
        matrix, distortion = start.K, np.reshape(start.distortion or (0.0,) * 4, (4, 1))
    try:
        found = cv2.fisheye.calibrate(points, pixels, size, matrix, distortion, flags=flags, criteria=_CRITERIA)
    except cv2.error:
        return None
    return found if np.isfinite(found[0]) and np.isfinite(found[1]).all() and np.isfinite(found[2]).all() else None


def _equidistant(fov: float, size: tuple[int, int]) -> Camera:
    """A fisheye without coefficients that sees so many degrees across."""
    focal = size[0] / np.radians(fov)
    return Camera(*size, focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2, (), "fisheye")


def _fisheye_flag(name: str) -> int:
    """OpenCV 5 moved the flags out of `cv2.fisheye`."""
    return int(getattr(cv2.fisheye, name, None) or getattr(cv2, name))


def _fisheye_deviations(rows: list[Float64], rms: float) -> Float64:
    """Standard deviations of fx, fy, cx, cy, k1..k4: the poses are eliminated from the normal equations, view by view.

    OpenCV's Jacobian has the columns f (2), c (2), k (4), rotation (3), translation (3).
    """
    normal = np.zeros((8, 8))
    for jacobian in rows:
        a, b = jacobian[:, :8], jacobian[:, 8:14]
        normal += a.T @ a - a.T @ b @ np.linalg.pinv(b.T @ b) @ b.T @ a
    variance = rms**2 / 2
    return np.sqrt(np.maximum(np.diag(np.linalg.pinv(normal)) * variance, 0.0))


def _refuse_undetermined(fit: _Solved) -> None:
    """Raises: InputError, in plain words, where the numbers would mislead."""
    if fit.rms > MAX_RMS:
        raise InputError(
            f"the corners miss their places by {fit.rms:.1f} px; the board is blurred, not flat, "
            "or not the one that --board says"
        )
    if fit.tilt < MIN_TILT:
        raise InputError(
            f"the board was always parallel to the picture (tilted by {fit.tilt:.0f} degrees at most), which leaves "
            "the focal length open; tilt it by 20 to 45 degrees to all sides"
        )
    deviation = max(fit.deviations["fx"] / fit.camera.fx, fit.deviations["fy"] / fit.camera.fy)
    if deviation > MAX_FOCAL_DEVIATION:
        raise InputError(
            f"these views leave the focal length open by {100 * deviation:.1f} %; show the board nearer, more tilted, "
            "and in more places"
        )


def _camera(size: tuple[int, int], matrix: Float64, distortion: tuple[float, ...], model: str) -> Camera:
    fx, fy, cx, cy = (float(matrix[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return Camera(size[0], size[1], fx, fy, cx, cy, distortion, model)


def _tilt(rotations: Iterable[Float64]) -> float:
    """Degrees between the board's normal and the viewing direction, the largest of all views."""
    cosines = [abs(float(cv2.Rodrigues(np.asarray(rotation))[0][2, 2])) for rotation in rotations]
    return float(np.degrees(np.arccos(np.clip(min(cosines), 0.0, 1.0))))


def _coverage(views: list[View], size: tuple[int, int]) -> Float64:
    pixels = np.concatenate([view.pixels for view in views])
    limits = [[0, size[1]], [0, size[0]]]
    return np.histogram2d(pixels[:, 1], pixels[:, 0], bins=(_CELLS[1], _CELLS[0]), range=limits)[0]


def _missing(coverage: Float64) -> str:
    """The side of the picture with the fewest corners, in words."""
    rows, columns = coverage.shape
    sides = {
        "the left": coverage[:, : columns // 4].sum(),
        "the right": coverage[:, -(columns // 4) :].sum(),
        "the top": coverage[: rows // 4 or 1].sum(),
        "the bottom": coverage[-(rows // 4 or 1) :].sum(),
    }
    return min(sides, key=lambda side: float(sides[side]))


def _sharpness(image: UInt8, pixels: Float32) -> float:
    """Steepest change of grey inside the board, against its contrast."""
    x, y = pixels.min(axis=0).astype(int), pixels.max(axis=0).astype(int)
    patch = image[max(0, x[1]) : y[1] + 1, max(0, x[0]) : y[0] + 1]
    if patch.size < 100:
        return 0.0
    gradient = np.hypot(cv2.Sobel(patch, cv2.CV_32F, 1, 0), cv2.Sobel(patch, cv2.CV_32F, 0, 1))
    return float(np.percentile(gradient, 99) / (np.ptp(patch) + 1.0))
