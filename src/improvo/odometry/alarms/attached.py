"""What moves with the camera: a logo, a time stamp, a bonnet, a finger. It stands in the picture while the rest moves.

A map of it fits as well as a map of the world, and says that the camera stands still. So it is found before any map is
asked. Two views far enough apart in the picture are matched afresh. An essential matrix of the matches that clearly
moved tells where a point of the world may be found again, at whatever depth: on its half of the epipolar line. A far
point under a pure translation, the focus of expansion and the axis of a turn are there though they hardly move. A match
that does not move and is off it is not of the world. It counts against its cell of the picture, and matches that move
with the world count for it; both are slowly forgotten. Keypoints of a cell with more against than for it make no map.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from improvo.geometry.a_contrario import SIGNIFICANT, line_probability, log10_false_alarms
from improvo.geometry.camera import Camera
from improvo.geometry.epipolar import half_line_distances
from improvo.geometry.ransac import Ransac, relative_pose
from improvo.odometry.gates import FAR, FEATURES, LARGE_PART, STEP_FRAMES
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.view import NO_POINT, View, common_tracks
from improvo.tracking.matching import match_units
from improvo.types import Float64, Int64, Mask

_COLUMNS, _ROWS = 16, 12  # cells of the picture
_MIN_MOVING = 20  # matches that moved; fewer say nothing about the camera
_MIN_FLOW = 4.0  # times the tolerance: their median motion, before two views are compared
_MIN_SHARE = 0.5  # of them that agree with it
_OFF = 1.5  # times the tolerance: a match so far from where a point of the world can be is not of it
_LONGEST = 30  # frames between two views that are compared
_MANY = 0.3  # share of the keypoints within such cells; then the frontend is asked for more of the world
_KEPT = 0.8  # share of the evidence that is left after each comparison
_ENOUGH = 3.0  # matches against a cell,
_MOST = 2  # of which one comparison gives so many
_PATIENCE = 5  # comparisons in a row that suspect something and find out nothing: a person before a still camera


class AttachedDetector:
    """Marks the keypoints of each view that belong to something attached to the camera.

    Args:
        camera: pinhole camera of the views.
        settings: of the odometry; `attached`, `tolerance` and `seed` are used.
        descriptor_distance: the matching threshold on unit descriptors.
    """

    def __init__(self, camera: Camera, settings: OdometrySettings, descriptor_distance: float) -> None:
        self._camera = camera
        self._enabled = settings.attached.enabled
        self._seed = settings.seed
        self._descriptor_distance = descriptor_distance
        self._noise = settings.tolerance * max(1.0, camera.width / 640.0)
        self._anchor: View | None = None
        self._most_moved = 0  # tracks that had moved since the anchor, at most
        self._against, self._for = np.zeros(_ROWS * _COLUMNS), np.zeros(_ROWS * _COLUMNS)
        self._suspected = np.zeros(_ROWS * _COLUMNS, bool)  # cells that stand, while too little moves to conclude
        self._in_vain = 0  # comparisons in a row that suspected something

    @property
    def cells(self) -> Mask:
        """(C,) cells of the picture, row by row, that show something attached to the camera."""
        against, world = _with_neighbours(self._against), _with_neighbours(self._for)
        return (against >= _ENOUGH) & (against > world)

    def dispensable(self, view: View) -> Mask | None:
        """(H, W) what is attached, or may be; None where few of a view's keypoints lie there.

        A frontend that keeps its strongest keypoints can have so few of the world that nothing can be concluded, or
        no map can start. There it is asked again, for the rest of the picture (`world_keypoints.py`).
        """
        cells = self.cells | self._suspected
        if not cells.any() or cells[self._cell(view.keypoints)].mean() <= _MANY:
            return None
        rows = np.arange(self._camera.height) * _ROWS // self._camera.height
        columns = np.arange(self._camera.width) * _COLUMNS // self._camera.width
        return np.asarray(cells.reshape(_ROWS, _COLUMNS)[np.ix_(rows, columns)])

    def observe(self, view: View) -> bool:
        """Mark the keypoints of the newest view.

        Returns:
            Whether other cells than before are attached now; earlier views can be marked anew with `mark`.
        """
        before = self.cells
        if self._enabled:
            self._compare(view)
        self.mark([view])
        return bool((self.cells & ~before).any())

    def mark(self, views: Iterable[View]) -> None:
        """Mark the keypoints of views by what is known now; a keypoint that moves is none, wherever it is."""
        cells = self.cells
        for view in views:
            view.attached = cells[self._cell(view.keypoints)]
            if view.attached.any() and self._anchor is not None and self._anchor is not view:
                rows, rows_anchor = common_tracks(view, self._anchor)
                moved = np.linalg.norm(view.keypoints[rows] - self._anchor.keypoints[rows_anchor], axis=1)
                view.attached[rows[moved > FAR * self._noise]] = False

    def drop(self, views: Sequence[View]) -> float:
        """Mark views anew, and drop what their marked keypoints observe; returns its share of all observations."""
        self.mark(views)
        observed = [each.points >= 0 for each in views]
        dropped = sum(int((each.attached & seen).sum()) for each, seen in zip(views, observed, strict=True))
        for each in views:
            each.points[each.attached] = NO_POINT
        return dropped / max(sum(int(seen.sum()) for seen in observed), 1)

    def _cell(self, pixels: Float64) -> Int64:
        column = np.clip(pixels[:, 0] * _COLUMNS / self._camera.width, 0, _COLUMNS - 1).astype(np.int64)
        row = np.clip(pixels[:, 1] * _ROWS / self._camera.height, 0, _ROWS - 1).astype(np.int64)
        return row * _COLUMNS + column

    def _compare(self, view: View) -> None:
        """With the anchor, where the picture moved enough since then; then this view is the anchor."""
        anchor = self._anchor
        if anchor is not None and view.frame_index - anchor.frame_index <= _LONGEST:
            # a track that is not younger than the anchor was seen in it, since tracks have no gaps
            few_left = (view.tracks <= anchor.tracks.max(initial=-1)).sum() < 2 * _MIN_MOVING
            rows, rows_anchor = common_tracks(view, anchor)
            motion = np.linalg.norm(view.keypoints[rows] - anchor.keypoints[rows_anchor], axis=1)
            moved = motion[motion > FAR * self._noise]
            self._most_moved = max(self._most_moved, len(moved))
            slow = len(moved) < _MIN_MOVING or np.median(moved) < _MIN_FLOW * self._noise
            # tracks of the world end, while a logo's stay
            ending = self._most_moved >= _MIN_MOVING and len(moved) < 0.5 * self._most_moved
            if not few_left and ((slow and not ending) or view.frame_index - anchor.frame_index < STEP_FRAMES):
                return
            self._weigh(anchor, view)
        self._anchor, self._most_moved = view, 0

    def _weigh(self, anchor: View, view: View) -> None:
        """Evidence from two views."""
        rows_before, rows_now = self._strongest(anchor), self._strongest(view)
        matches = match_units(anchor.descriptors[rows_before], view.descriptors[rows_now], self._descriptor_distance)
        before, now = anchor.keypoints[rows_before[matches[:, 0]]], view.keypoints[rows_now[matches[:, 1]]]
        cells = self._cell(now)
        motion = np.linalg.norm(now - before, axis=1)
        still, moved = motion <= self._noise, np.flatnonzero(motion > FAR * self._noise)
        if len(moved) < _MIN_MOVING or not self._enough_moves(cells[still], cells[moved]):
            self._suspect(cells[still], cells[moved])
            return
        ransac = Ransac(self._noise, self._seed, min_iterations=100, max_iterations=1000)
        world = relative_pose(before[moved], now[moved], self._camera, ransac)
        chance = line_probability(self._camera.width, self._camera.height, self._noise)
        inliers = int(world.inliers.sum())
        if inliers < _MIN_SHARE * len(moved) or (
            log10_false_alarms(len(moved), inliers, chance, sample=5, models=10) > SIGNIFICANT
        ):
            self._suspect(cells[still], cells[moved])
            return
        self._suspected[:], self._in_vain = False, 0
        errors = half_line_distances(world.pose, self._camera, before[still], now[still])
        self._against *= _KEPT
        self._for *= _KEPT
        self._against += self._counted(cells[still][errors > _OFF * self._noise])
        self._for += self._counted(cells[moved[world.inliers]])

    def _strongest(self, view: View) -> Int64:
        """Rows of a view's keypoints; of the world as many as if nothing were attached."""
        apart = (self.cells | self._suspected)[self._cell(view.keypoints)]
        parts = [np.flatnonzero(part)[:FEATURES] for part in (apart, ~apart)]
        return np.sort(np.concatenate(parts)) if apart.any() else parts[1]

    def _enough_moves(self, still: Int64, moved: Int64) -> bool:
        """Whether enough of the picture moves, by the cells of the matches that stand and of those that moved.

        While the frontend is asked for more of the world, all of the picture counts, since cells of the world are then
        filled more than others.
        """
        occupied = len(np.unique(still)), len(np.unique(moved))
        whole = self._suspected.size if self._suspected.any() else sum(occupied)
        return occupied[1] >= LARGE_PART * whole

    def _suspect(self, still: Int64, moved: Int64) -> None:
        """Nothing can be concluded: the frontend may have spent its keypoints on what stands."""
        counts = [np.bincount(each, minlength=self._suspected.size) for each in (still, moved)]
        self._in_vain += 1
        self._suspected = (counts[0] > counts[1]) & (self._in_vain <= _PATIENCE)

    def _counted(self, cells: Int64) -> Float64:
        """Matches in each cell (C,); a single comparison may not decide about one."""
        return np.minimum(np.bincount(cells, minlength=_ROWS * _COLUMNS), _MOST).astype(np.float64)


def _with_neighbours(evidence: Float64) -> Float64:
    """Evidence (C,) of each cell and a quarter of what the four cells beside it have: few things are one cell large."""
    grid = np.pad(evidence.reshape(_ROWS, _COLUMNS), 1)
    beside = grid[:-2, 1:-1] + grid[2:, 1:-1] + grid[1:-1, :-2] + grid[1:-1, 2:]
    return np.asarray(grid[1:-1, 1:-1] + 0.25 * beside).ravel()
