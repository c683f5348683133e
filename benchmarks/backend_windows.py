"""The windows of the backend benchmark: simulated ones, and ones cut from a real sequence."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from improvo.backend import BundleProblem
from improvo.backend.simulated import simulated_window
from improvo.frontend.registry import load_frontend
from improvo.geometry import se3
from improvo.geometry.triangulation import Triangulation, triangulate_tracks
from improvo.sequences import open_sequence
from improvo.tracking.connect import TrackChain
from improvo.tracking.matching import mutual_nearest_neighbours
from improvo.types import Float64, Int64

MIN_TRACK = 3  # observations
MAX_TRUTH_ERROR = 15.0  # pixels under the true poses, above which a real link is left out
POSE_ERROR, POINT_ERROR = 0.005, 0.05  # of the perturbed start: radians and map units; share of the depth


@dataclass(frozen=True)
class Recording:
    """Tracks over consecutive frames with true poses; the median depth of the first frames is 1."""

    name: str
    cam_from_world: Float64  # (N, 4, 4)
    K: Float64  # (3, 3)
    camera_index: Int64  # (O,) sorted by track, then camera
    track: Int64  # (O,) 0 ... T - 1
    keypoints: Float64  # (O, 2)

    def take(self, rows: Int64) -> Recording:
        """With these observations only, the tracks numbered anew."""
        _, track = np.unique(self.track[rows], return_inverse=True)
        return replace(self, camera_index=self.camera_index[rows], track=track, keypoints=self.keypoints[rows])

    def offsets(self) -> Int64:
        """(T + 1,) first observation of each track."""
        return np.concatenate([[0], np.cumsum(np.bincount(self.track))])


def simulated_recording(frames: int, tracks: int, seed: int, outliers: float) -> Recording:
    """Half a pixel of noise and a share of wrong observations."""
    window = simulated_window(seed=seed, cameras=frames, points=tracks, outliers=outliers, mean_track=30.0, fixed=0)
    problem = window.problem
    return _unit_depth(
        Recording(
            "simulated",
            window.cam_from_world,
            problem.K,
            problem.camera_index,
            problem.point_index,
            problem.keypoints,
        )
    )


def real_recording(folder: Path, start: int, frames: int) -> Recording:
    """SIFT tracks of consecutive frames, connect-the-dots, under the ground-truth poses."""
    sequence = open_sequence(folder)
    frontend, chain = load_frontend("sift", max_keypoints=2000, opencv_defaults=True), TrackChain()
    features, ids = [], []
    for i in range(start, start + frames):
        features.append(frontend(sequence[i].image))
        if len(features) == 1:
            ids.append(chain.start(len(features[0])))
        else:
            matches = mutual_nearest_neighbours(features[-2], features[-1], 0.7)
            ids.append(chain.extend(ids[-1], matches, len(features[-1])))
    camera_index = np.repeat(np.arange(frames), [len(f) for f in features])
    track = np.concatenate(ids)
    order = np.lexsort((camera_index, track))
    keypoints = np.concatenate([f.keypoints for f in features]).astype(np.float64)
    world_from_cam = sequence.ground_truth.world_from_cam[start : start + frames]
    recording = Recording(
        f"{folder.name} {start}",
        se3.inverse(world_from_cam),
        sequence.camera.K,
        camera_index[order],
        track[order],
        keypoints[order],
    )
    long_enough = np.bincount(recording.track)[recording.track] >= MIN_TRACK
    recording = recording.take(np.flatnonzero(long_enough))
    # the truth of this set is 5 px off over ten frames: only what is grossly wrong is left out
    found = triangulate(recording)
    rows = np.flatnonzero(found.in_front[recording.track] & (found.errors < MAX_TRUTH_ERROR))
    recording = recording.take(rows)
    recording = recording.take(np.flatnonzero(np.bincount(recording.track)[recording.track] >= MIN_TRACK))
    return _unit_depth(recording)


def cut_window(recording: Recording, free: int, constant: int, points: int, seed: int) -> BundleProblem:
    """The first `constant + free` frames as a problem of at most `points` points, moved away from the truth.

    The first `constant` poses are constants, or the very first where there are none.
    """
    rng = np.random.default_rng(seed)
    cameras = free + constant
    part = recording.take(np.flatnonzero(recording.camera_index < cameras))
    in_window = np.bincount(part.track[part.camera_index >= constant], minlength=part.track.max() + 1)
    part = part.take(np.flatnonzero((np.bincount(part.track) >= MIN_TRACK)[part.track] & (in_window > 0)[part.track]))
    found = triangulate(part).ok
    chosen = np.isin(np.arange(len(found)), rng.permutation(np.flatnonzero(found))[:points])
    part = part.take(np.flatnonzero(chosen[part.track]))
    xyz = triangulate(part).points
    fixed = np.arange(cameras) < max(constant, 1)
    jitter = se3.rigid(se3.so3_exp(rng.normal(0, POSE_ERROR, (cameras, 3))), rng.normal(0, POSE_ERROR, (cameras, 3)))
    truth = recording.cam_from_world[:cameras]
    middle = se3.inverse(truth)[cameras // 2, :3, 3]
    return BundleProblem(
        cam_from_world=np.where(fixed[:, None, None], truth, jitter @ truth),
        points=middle + (xyz - middle) * rng.normal(1, POINT_ERROR, (len(xyz), 1)),
        camera_index=part.camera_index,
        point_index=part.track,
        keypoints=part.keypoints,
        weights=np.ones(len(part.track)),
        K=recording.K,
        fixed_cameras=fixed,
    )


def triangulate(recording: Recording, cam_from_world: Float64 | None = None) -> Triangulation:
    """All tracks under the given poses, or the true ones."""
    poses = recording.cam_from_world if cam_from_world is None else cam_from_world
    return triangulate_tracks(recording.keypoints, recording.camera_index, recording.offsets(), poses, recording.K)


def _unit_depth(recording: Recording) -> Recording:
    """Scale the world so that the median depth in the first frames is 1, as the paper's start assumes."""
    early = recording.take(np.flatnonzero(recording.camera_index < 30))
    points, poses = triangulate(early).points[early.track], recording.cam_from_world[early.camera_index]
    depth = np.nanmedian(np.einsum("oj,oj->o", poses[:, 2, :3], points) + poses[:, 2, 3])
    scaled = recording.cam_from_world.copy()
    scaled[:, :3, 3] /= depth
    return replace(recording, cam_from_world=scaled)
