"""The odometry over raw features with a guess of the lens: a scene of selected views and the points that they see."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.odometry.result.final_view import FinalView
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.visual_odometry import VisualOdometry
from improvo.self_calibration.adjustment import Scene
from improvo.self_calibration.lens import Lens
from improvo.self_calibration.raw_features import Piece
from improvo.sequences.rectification import Rectifier
from improvo.types import Features, Float64, Int64, Mask, SparseMap, UInt8

_WORLDS = 100_000  # more than a piece has segments
_STEPS = (0.03, 0.015, 0.008)  # motion of the median point between two views, shares of the width; until enough


@dataclass(frozen=True)
class TrackedPiece:
    """What the odometry found of a piece."""

    views: list[FinalView]  # with a pose, in temporal order
    pixels: list[Float64]  # (N, 2) raw pixels of the keypoints of each view
    map: SparseMap


def track_piece(
    piece: Piece, lens: Lens, settings: OdometrySettings, progress: Callable[[], object] = lambda: None
) -> TrackedPiece:
    """Run the odometry over a piece as if the lens were known.

    Args:
        piece: features of raw pictures.
        lens: the guess.
        settings: of the odometry.
        progress: is called after every frame.

    Raises:
        InputError: the distortion of the lens cannot be undone.
    """
    camera = Rectifier(lens.camera).camera
    kept = []
    final: list[FinalView] = []
    odometry = VisualOdometry(_NoFrontend(), camera, settings, use_stability=False, on_final=final.append)
    for features, time in zip(piece.features, piece.times, strict=True):
        undistorted, rows = _undistorted(features, lens, camera)
        kept.append(rows)
        odometry.track_features(undistorted, time)
        progress()
    odometry.finish()
    views = sorted((view for view in final if view.segment >= 0), key=lambda view: view.frame_index)
    pixels = [piece.features[view.frame_index].keypoints[kept[view.frame_index]].astype(np.float64) for view in views]
    return TrackedPiece(views, pixels, odometry.map)


def scene_of(pieces: list[TrackedPiece], lens: Lens, max_views: int) -> Scene:
    """Views that differ, and the points that at least three of them see, as one scene of one lens.

    Pieces and segments of the odometry share no point; each has a world of its own.

    Args:
        pieces: tracked with `lens`.
        lens: where the adjustment starts from.
        max_views: of all pieces together.
    """
    for step in _STEPS:
        chosen = [_different_views(piece, step * lens.width) for piece in pieces]
        total = sum(map(len, chosen))
        if total > max_views / 2:
            break
    chosen = [
        rows[np.unique(np.linspace(0, len(rows) - 1, max(2, round(len(rows) * max_views / total))).astype(int))]
        if total > max_views and len(rows)
        else rows
        for rows in chosen
    ]
    poses: list[Float64] = []
    motions: list[Float64] = []
    worlds: list[int] = []
    xyz, view_of, point_of, pixels = [], [], [], []
    points_before = 0
    for number, (piece, rows) in enumerate(zip(pieces, chosen, strict=True)):
        order = np.argsort(piece.map.ids)
        ids = piece.map.ids[order]
        for row in rows.tolist():
            view = piece.views[row]
            seen = np.flatnonzero(view.points >= 0)
            place = np.searchsorted(ids, view.points[seen])
            known = (place < len(ids)) & (ids[np.minimum(place, len(ids) - 1)] == view.points[seen])
            seen, place = seen[known], place[known]
            view_of.append(np.full(len(seen), len(poses)))
            point_of.append(points_before + place)
            pixels.append(piece.pixels[row][seen])
            poses.append(se3.inverse(view.world_from_cam))
            motions.append(_motion(piece.views, row))
            worlds.append(_WORLDS * number + view.segment)
        xyz.append(piece.map.xyz[order])
        points_before += len(ids)
    point = np.concatenate(point_of)
    view = np.concatenate(view_of)
    order = np.lexsort((view, point))
    scene = Scene(
        lens,
        np.array(poses),
        np.concatenate(xyz),
        view[order].astype(np.int64),
        point[order].astype(np.int64),
        np.concatenate(pixels)[order],
        np.array(worlds),
        np.array(motions),
    )
    return scene.only(scene.kept(np.zeros(len(view), bool)))


def _motion(views: list[FinalView], row: int) -> Float64:
    """(6,) how points move in the frame of a view's camera: shift and turn a second, from the views before and after.

    Zero where the view has no neighbour in its segment.
    """
    near = [views[place] for place in (row - 1, row, row + 1) if 0 <= place < len(views)]
    near = [view for view in near if view.segment == views[row].segment]
    first, last = near[0], near[-1]
    seconds = last.time - first.time
    if seconds <= 0:
        return np.zeros(6)
    last_from_first = se3.inverse(last.world_from_cam) @ first.world_from_cam
    turn = se3.so3_log(last_from_first[:3, :3])
    return np.concatenate([last_from_first[:3, 3], turn]) / seconds


def _different_views(piece: TrackedPiece, step: float) -> Int64:
    """Rows of views, each of which moved by so many pixels since the one before."""
    chosen: list[int] = []
    for row, view in enumerate(piece.views):
        if not chosen or view.segment != piece.views[chosen[-1]].segment:
            chosen.append(row)
            continue
        last = piece.views[chosen[-1]]
        _, here, there = np.intersect1d(view.points, last.points, return_indices=True)
        seen = view.points[here] >= 0
        moved = np.linalg.norm(piece.pixels[row][here[seen]] - piece.pixels[chosen[-1]][there[seen]], axis=1)
        if len(moved) == 0 or float(np.median(moved)) > step:
            chosen.append(row)
    return np.array(chosen, np.int64)


def _undistorted(features: Features, lens: Lens, camera: Camera) -> tuple[Features, Int64]:
    """Features where the pinhole camera of the odometry would have them, and the rows that it sees."""
    rays = lens.rays(features.keypoints.astype(np.float64))
    pixels = rays * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    inside = (pixels >= -0.5).all(axis=1) & (pixels <= (camera.width - 0.5, camera.height - 0.5)).all(axis=1)
    rows = np.flatnonzero(inside)
    taken = features.take(rows)
    return Features(pixels[rows].astype(np.float32), taken.descriptors, taken.scores, taken.stability), rows


class _NoFrontend:
    """Stands where the odometry wants a frontend, which it does not need: the features are at hand."""

    name = "features at hand"

    def __call__(self, image: UInt8, mask: Mask | None = None) -> Features:
        raise AssertionError("the features are at hand")
