"""Does the path depend on which part of the evidence is believed? The path again, from parts of the observations.

The keyframes of a segment are adjusted again in windows that overlap, each time from another part of what they
observed: without one quarter of the picture, or with one half of the points. Each part gives a path of its own. Noise
and few matches spread the paths from halves of the points. What one part of the picture says otherwise (an overlay, a
mover, a wrong lens) spreads the paths without its quarters. A place that few points carry the scale across lets each
part go on with another scale there. This is a jackknife (Quenouille 1949; Tukey 1958) over picture and points.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from improvo.backend.solver import solve
from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.odometry.gates import SAME_SCALE
from improvo.odometry.mapping.bundle_adjustment import OBJECTIVE, SOLVER
from improvo.odometry.verdict.evidence_window import EvidenceKeyframe, EvidenceWindow
from improvo.odometry.verdict.lens_evidence import LensMeasure, measured_lens
from improvo.odometry.verdict.path_error import error_percent, scale_leverage
from improvo.odometry.verdict.seen_again import SeenAgain, leaps, looked_again
from improvo.odometry.verdict.shared_errors import shared_error
from improvo.odometry.verdict.turning_camera import TurningCamera, turning_camera
from improvo.odometry.view import View
from improvo.types import Float64, Int64, Mask

QUARTERS = ("without the upper left", "without the upper right", "without the lower left", "without the lower right")
HALVES = ("half of the points", "the other half of the points")
PARTS = (*QUARTERS, *HALVES)

_WINDOW = 12  # keyframes that are adjusted together from each part of the evidence; half of them overlap
_FEW = 8  # observations or common points; fewer determine nothing
_THIN = 6  # points seen on both sides of a gap between two keyframes; fewer carry no scale across it
_UNKNOWN_SCALE = float(np.log(2.0))  # where no point is, the scale of what follows may as well be half or double
_HASH = 2654435761  # a multiplier of Knuth's, so that the halves of the points are no halves of time or place


@dataclass(frozen=True)
class Spread:
    """How far the paths from the parts of the evidence are from the segment's own.

    Attributes:
        error_percent: (PARTS,) root mean square distance of the keyframes' positions after Sim3, % of the path.
        scale_steps: (L, PARTS) change of the logarithm of a part's scale across each of L links between windows, and
            across each gap that no point bridges.
        link_frames: (L, 2) first and last frame of the keyframes on both sides of each link.
        leverage: (L,) what a change of scale there does to the path: % of it, per unit of the logarithm.
        noise_px: of the observations, standard deviation of one coordinate; NaN where nothing was observed.
        width: of the picture in pixels.
        lens: what the windows say of the focal length.
        shared_px: of the residuals, what neighbours in the picture have in common (`shared_errors.py`).
        turning: what a camera that only turns says of the windows; empty where the focal length is no guess.
        views_per_point: keyframes that observe a point, mean.
        leaps: gaps between keyframes across which the place may only look the same (`seen_again.py`).
        frames: first and last keyframe's.
    """

    error_percent: Float64
    scale_steps: Float64
    link_frames: Int64
    leverage: Float64
    noise_px: float
    width: int
    lens: tuple[LensMeasure, ...] = ()
    shared_px: float = 0.0
    turning: tuple[TurningCamera, ...] = ()
    views_per_point: float = 1.0
    leaps: tuple[SeenAgain, ...] = ()
    frames: tuple[int, int] = (0, 0)


@dataclass
class _Solution:
    """A window adjusted from one part of its observations, in a gauge of its own."""

    cam_from_world: Float64  # (W, 4, 4)
    rows: Int64  # (K,) rows of the window's points that it has, increasing
    ids: Int64  # (K,) map points
    xyz: Float64  # (K, 3)


@dataclass
class _Path:
    """The path that one part of the evidence gives, window after window."""

    centers: list[Float64] = field(default_factory=list)  # (3,) each, one per keyframe
    world_from_cam: list[Float64] = field(default_factory=list)  # (4, 4) each, of the last window's keyframes
    scale: float = 1.0  # world units of this path per unit of the last window's gauge
    own_scale: float = 0.0  # logarithm of the path's scale over the segment's, in the last window
    last: _Solution | None = None


class EvidenceCheck:
    """Takes a segment's keyframes as they become final, and adjusts them again from each part of the evidence.

    Args:
        camera: pinhole camera of the views.
        camera_is_guess: its focal length is a guess; whether the camera only turned is then asked, too.
    """

    def __init__(self, camera: Camera, camera_is_guess: bool = False) -> None:
        self._camera = camera
        self._camera_is_guess = camera_is_guess
        self._turning: list[TurningCamera] = []
        self._pending: list[EvidenceKeyframe] = []  # of the next window; those of the overlap are first
        self._overlap = 0
        self._paths = [_Path() for _ in PARTS]
        self._centers: list[Float64] = []  # of the segment itself, one per keyframe
        self._frames: list[int] = []  # of each keyframe
        self._across: dict[int, int] = {}  # points on both sides of the gap after a keyframe, by any window
        self._errors: list[float] = []  # pixels, median of each window
        self._shared: list[float] = []  # pixels, of each window
        self._observations = 0
        self._is_seen = np.zeros(0, np.bool_)  # by map point
        self._scale_steps: list[Float64] = []
        self._links: list[tuple[int, int]] = []
        self._places: list[tuple[int, int]] = []  # of each link: the scale may be another behind one of these keyframes
        self._seen_again: list[SeenAgain] = []
        self._lens: list[LensMeasure] = []
        self._lens_due = True  # every other window: those between them share half of their keyframes with each

    def add(self, view: View, cam_from_world: Float64, xyz: Float64) -> None:
        """The next keyframe is final.

        Args:
            view: the keyframe.
            cam_from_world: (4, 4) its pose.
            xyz: (P, 3) the map as it is now.
        """
        rows = view.observed
        keyframe = EvidenceKeyframe(
            view.frame_index, cam_from_world, view.keypoints[rows], view.points[rows], view.weights[rows]
        )
        self._pending.append(keyframe)
        looked_again(self._seen_again, self._pending, xyz, self._camera)
        self._centers.append(se3.inverse(cam_from_world)[:3, 3])
        self._frames.append(view.frame_index)
        if len(xyz) > len(self._is_seen):
            self._is_seen = np.concatenate([self._is_seen, np.zeros(len(xyz), np.bool_)])
        self._is_seen[keyframe.points] = True
        self._observations += len(keyframe.points)
        if len(self._pending) == _WINDOW:
            self._solve_window(xyz)

    def finish(self, xyz: Float64) -> Spread | None:
        """The segment is over.

        Args:
            xyz: (P, 3) its points.

        Returns:
            None where the segment has too few keyframes for a spread.
        """
        if len(self._pending) > self._overlap and len(self._centers) >= 3:
            self._solve_window(xyz)
        if len(self._centers) < 3:
            return None
        own = np.stack(self._centers)
        found = self._mark_unknown_gaps()
        errors = [error_percent(np.stack(path.centers), own) for path in self._paths]
        return Spread(
            error_percent=np.array(errors),
            scale_steps=np.array(self._scale_steps).reshape(-1, len(PARTS)),
            link_frames=np.array(self._links, np.int64).reshape(-1, 2),
            leverage=scale_leverage(own, self._places),
            noise_px=float(np.median(self._errors)) / 1.1774 if self._errors else float("nan"),
            width=self._camera.width,
            lens=tuple(self._lens),
            shared_px=float(np.median(self._shared)) if self._shared else 0.0,
            turning=tuple(self._turning),
            views_per_point=self._observations / max(int(self._is_seen.sum()), 1),
            leaps=found,
            frames=(self._frames[0], self._frames[-1]),
        )

    def _mark_unknown_gaps(self) -> tuple[SeenAgain, ...]:
        """The scale behind a gap is unknown where no point bridges it, or a place that may only look the same.

        Returns:
            Gaps of the second kind.
        """
        places = {gap for gap, count in self._across.items() if count == 0}
        found = leaps(self._seen_again)
        places.update(self._frames.index(gap.frames[0]) for gap in found)
        for gap in sorted(places):
            self._scale_steps.append(np.full(len(PARTS), _UNKNOWN_SCALE))
            self._links.append((self._frames[gap], self._frames[gap + 1]))
            self._places.append((gap, gap))
        return found

    def _solve_window(self, xyz: Float64) -> None:
        """All parts of the pending keyframes; the second half of them is the overlap with the next window."""
        keyframes = self._pending
        window = EvidenceWindow.of(keyframes, xyz)
        errors = np.linalg.norm(window.residuals(self._camera)[0], axis=1)
        self._errors.extend([float(np.median(errors))] if len(errors) else [])
        self._shared.append(shared_error(window, self._camera))
        frames = keyframes[0].frame_index, keyframes[-1].frame_index
        steps = np.zeros(len(PARTS))
        for part, (path, mask) in enumerate(zip(self._paths, self._masks(window), strict=True)):
            steps[part] = _continue(path, self._solved(window, mask), window, self._overlap)
        across = window.across()
        before = len(self._centers) - len(keyframes)
        for gap, count in enumerate(across.tolist()):
            self._across[before + gap] = max(self._across.get(before + gap, 0), count)
        thin = across.min() < _THIN
        if thin:
            steps = np.maximum(np.abs(steps), SAME_SCALE)
        if self._overlap or thin:
            self._scale_steps.append(steps)
            self._links.append(frames)
            thinnest = before + int(across.argmin())
            newest = before + max(self._overlap - 1, 0), before + len(keyframes) - 2
            self._places.append((thinnest, thinnest) if thin else newest)
        if self._lens_due and len(keyframes) >= _FEW:
            self._lens.append(measured_lens(window, frames, self._camera))
        if self._lens_due and self._camera_is_guess:
            turning = turning_camera(window, self._camera)
            self._turning += [turning] if turning is not None else []
        self._lens_due = not self._lens_due
        self._overlap = min(_WINDOW // 2, len(keyframes))
        self._pending = keyframes[len(keyframes) - self._overlap :]
        for path in self._paths:
            path.world_from_cam = path.world_from_cam[-self._overlap :]

    def _masks(self, window: EvidenceWindow) -> list[Mask]:
        """Which observations (O,) belong to each of PARTS."""
        left = window.keypoints[:, 0] < 0.5 * self._camera.width
        upper = window.keypoints[:, 1] < 0.5 * self._camera.height
        half = ((window.ids[window.point] * _HASH) >> 7) & 1 == 0
        return [~(upper & left), ~(upper & ~left), ~(~upper & left), ~(~upper & ~left), half, ~half]

    def _solved(self, window: EvidenceWindow, mask: Mask) -> _Solution:
        """The window from a part of its observations; where it starts, if they are too few."""
        problem, rows = window.problem(window.seen_at_least(2, mask), self._camera.K)
        if len(problem.keypoints) < _FEW * len(window):
            return _Solution(window.cam_from_world, rows, window.ids[rows], window.xyz[rows])
        result = solve(problem, OBJECTIVE, SOLVER)
        return _Solution(result.cam_from_world, rows, window.ids[rows], result.points)


def _continue(path: _Path, solution: _Solution, window: EvidenceWindow, overlap: int) -> float:
    """Append a solved window to a path; returns how the logarithm of the path's scale has changed.

    The overlap's middle keyframe carries pose and the points seen in the overlap carry scale from window to window.
    """
    poses = solution.cam_from_world
    reference = max(overlap - 1, 0) // 2
    if path.last is None:
        world_from_reference = se3.inverse(poses[0])
    else:
        world_from_reference = path.world_from_cam[reference]
        before, after = _common(path.last, solution, window.ids[np.unique(window.point[window.camera < overlap])])
        before_from_world = path.last.cam_from_world[len(path.last.cam_from_world) - overlap + reference]
        path.scale *= _ratio(se3.transform(before_from_world, before), se3.transform(poses[reference], after))
    for pose in poses[overlap:]:
        reference_from_cam = poses[reference] @ se3.inverse(pose)
        reference_from_cam[:3, 3] *= path.scale
        path.world_from_cam.append(world_from_reference @ reference_from_cam)
        path.centers.append(path.world_from_cam[-1][:3, 3])
    newest = np.isin(solution.rows, window.newest)
    theirs = se3.transform(poses[-1], solution.xyz[newest])
    own = se3.transform(window.cam_from_world[-1], window.xyz[solution.rows[newest]])
    own_scale = float(np.log(path.scale * _ratio(theirs, own)))
    step, path.own_scale, path.last = own_scale - path.own_scale, own_scale, solution
    return step


def _common(a: _Solution, b: _Solution, seen: Int64) -> tuple[Float64, Float64]:
    """Positions (C, 3) in both solutions of the points that both have and the overlap has seen."""
    ids, rows_a, rows_b = np.intersect1d(a.ids, b.ids, assume_unique=True, return_indices=True)
    use = np.isin(ids, seen)
    return a.xyz[rows_a[use]], b.xyz[rows_b[use]]


def _ratio(a: Float64, b: Float64) -> float:
    """Median ratio of the distances of points (N, 3) in the same camera, in two units; 1 where they are too few."""
    if len(a) < _FEW:
        return 1.0
    return float(np.median(np.linalg.norm(a, axis=1) / np.maximum(np.linalg.norm(b, axis=1), 1e-12)))
