"""The nouns that the rooms pass to each other, as frozen dataclasses with shapes.

Conventions (see docs/conventions.md): pixels are (x right, y down) with the centre of the top-left pixel at (0, 0);
`cam_from_world` maps world points into a camera; times are seconds; features are float32, geometry float64.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]
UInt8 = NDArray[np.uint8]
Mask = NDArray[np.bool_]  # which rows (N,), or which pixels (H, W) of a picture are used


@dataclass(frozen=True)
class Frame:
    """One image of a sequence, as delivered: undistorted, resized, grey."""

    source_index: int  # number of the frame in the recording, before any stride
    time: float  # seconds, the recording's own clock
    image: UInt8  # (H, W)
    source: str  # the file, or "video.mp4#123"
    mask: Mask | None = None  # (H, W) where keypoints may be; None is everywhere


@dataclass(frozen=True)
class Features:
    """Keypoints of one image with their descriptors (paper, "Convolutional Frontend")."""

    keypoints: Float32  # (N, 2) x, y in pixels
    descriptors: NDArray[np.generic]  # (N, D) float32 of unit L2 norm, or (N, B) uint8 packed bits
    scores: Float32  # (N,) detection confidence, larger is better
    stability: Float32 | None = None  # (N,) probability in [0, 1]; None where the frontend has no stability head

    def __len__(self) -> int:
        return len(self.keypoints)

    @property
    def binary(self) -> bool:
        """Whether descriptors are bit strings, compared by Hamming distance."""
        return bool(self.descriptors.dtype == np.uint8)

    def weights(self) -> Float32:
        """Observation confidence w_ij (N,), paper "Observation Variables": the stability, or 1 without that head."""
        if self.stability is None:
            return np.ones(len(self), np.float32)
        return self.stability

    def take(self, rows: NDArray[np.generic]) -> Features:
        """The features of the given rows (indices or mask), in that order."""
        stability = None if self.stability is None else self.stability[rows]
        return Features(self.keypoints[rows], self.descriptors[rows], self.scores[rows], stability)

    def best(self, count: int) -> Features:
        """The `count` features of the highest score, or all, best first; of equal scores the earlier comes first."""
        return self.take(np.argsort(-self.scores, kind="stable")[:count])


@dataclass(frozen=True)
class Tracks:
    """Connect-the-dots tracks as flat observations, one row per (frame, track), sorted by track, then frame."""

    frame: Int64  # (M,) frame_index: number of the frame in the processed sequence (after any stride), from 0
    track: Int64  # (M,) track id
    keypoints: Float32  # (M, 2) pixels
    weight: Float32  # (M,) observation confidence w_ij

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True)
class Trajectory:
    """Camera poses over time; a row without a pose is NaN.

    Poses of one segment share a world frame and a scale; those of different segments do not.

    Raises:
        ValueError: another number of poses or segments than of times, or poses that are not 4x4 matrices.
    """

    times: Float64  # (N,) seconds, increasing
    world_from_cam: Float64  # (N, 4, 4), NaN where there is no pose
    segment: Int64 = field(default_factory=lambda: np.zeros(0, np.int64))  # (N,) segment number, -1 without pose

    def __post_init__(self) -> None:
        if np.shape(self.world_from_cam) != (len(self.times), 4, 4):
            shape, wanted = np.shape(self.world_from_cam), (len(self.times), 4, 4)
            raise ValueError(f"Trajectory.world_from_cam: shape {shape}, expected {wanted}, a matrix for each time")
        if np.shape(self.segment) not in ((0,), (len(self.times),)):
            shape, rows = np.shape(self.segment), (len(self.times),)
            raise ValueError(f"Trajectory.segment: shape {shape}, expected {rows}, a number for each time")
        if len(self.segment) != len(self.times):
            object.__setattr__(self, "segment", np.where(self.valid, 0, -1).astype(np.int64))

    def __len__(self) -> int:
        return len(self.times)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(N,) whether the row has a pose."""
        return np.asarray(np.isfinite(self.world_from_cam).all(axis=(1, 2)))

    @property
    def camera_centers(self) -> Float64:
        """(N, 3) camera centers in the world."""
        return self.world_from_cam[:, :3, 3]


@dataclass(frozen=True)
class SparseMap:
    """3D points of a finished run (paper, "Optimization Variables")."""

    ids: Int64  # (P,) point id, each once; all -1 where a file does not tell
    xyz: Float64  # (P, 3) world
    observations: Int64  # (P,) number of images that the point was observed in
    mean_error: Float64  # (P,) pixels
    max_error: Float64  # (P,) pixels
    segment: Int64  # (P,) segment that the point belongs to
    rgb: UInt8 | None = None  # (P, 3) as the recording shows it; None where that is not known

    def __len__(self) -> int:
        return len(self.ids)

    def rows_of(self, ids: Int64) -> Int64:
        """(N,) the row of each point id (N,); -1 for what is no point of this map."""
        order = np.argsort(self.ids)
        place = np.searchsorted(self.ids, ids, sorter=order)
        row = np.append(order, -1)[place]
        return np.where((ids >= 0) & (row >= 0) & (np.append(self.ids, -1)[row] == ids), row, -1)
