"""Correspondences of depth maps after they were moved to where the pictures agree, as training does it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from depth_cases import Case
from depth_measures import FAR_OFF_PIXELS, Maps
from improvo.geometry import se3
from improvo.types import Float64

CORNERS, QUALITY, APART = 300, 0.003, 7  # Shi-Tomasi corners of a frame, at least so many pixels apart
SAME_DEPTH = 0.03  # of a place in both maps, relative, as in training


@dataclass(frozen=True)
class AlignedCorrespondences:
    """Of corners of frames so far apart, in pixels of the frames."""

    gap: int
    visible: float  # share of the corners that both maps show
    certain: float  # share of those at which the pictures agree
    contradicted: float  # share of those that the pictures put elsewhere
    own_to_picture: float  # median distance from the correspondence of the maps to where the pictures agree
    truth_to_picture: float  # likewise, from where depth image and true poses put it
    before: float  # median distance of all that are kept to the truth, not moved
    after: float  # and moved
    far_before: float  # share over FAR_OFF_PIXELS
    far_after: float


def aligned_correspondences(case: Case, maps: Maps, gap: int, every: int) -> AlignedCorrespondences | None:
    """Of each `every`-th frame with the one `gap` later; None without a pair."""
    columns: list[list[np.ndarray]] = [[] for _ in range(6)]
    shares = []
    for a in range(0, len(case.sequence) - gap, every):
        found = _pair(case, maps, a, a + gap)
        if found is not None:
            shares.append(found[0])
            for column, values in zip(columns, found[1:], strict=True):
                column.append(values)
    if not shares:
        return None
    certain, contradicted, own, true, before, after = (np.concatenate(column) for column in columns)
    known = np.isfinite(before) & ~contradicted
    if not known.any():
        return None
    return AlignedCorrespondences(
        gap,
        float(np.mean(shares)),
        float(certain.mean()),
        float(contradicted.mean()),
        float(np.median(own[certain])) if certain.any() else np.nan,
        float(np.nanmedian(true[certain])) if np.isfinite(true[certain]).any() else np.nan,
        float(np.median(before[known])),
        float(np.median(after[known])),
        float((before[known] > FAR_OFF_PIXELS).mean()),
        float((after[known] > FAR_OFF_PIXELS).mean()),
    )


def _pair(case: Case, maps: Maps, a: int, b: int) -> tuple[np.ndarray, ...] | None:
    """Share of the corners seen; of those certain, contradicted, own and true to picture, truth to own and moved."""
    import torch

    from improvo.training.batches.alignment import aligned
    from improvo.training.batches.picture_store import PictureStore
    from improvo.training.batches.posed_frames import PosedFrames
    from improvo.training.data.posed_sequence import PosedSequence
    from improvo.training.held_settings import AlignmentSettings

    poses = case.cam_from_world[[a, b]], case.truth.cam_from_world[[a, b]]
    if a not in maps or b not in maps or not np.isfinite(poses).all() or case.segment[a] != case.segment[b]:
        return None
    height, width = maps[a].depth.shape
    truth = case.truth.depth(a, (width, height))
    if truth is None:
        return None
    pictures = tuple(case.sequence[frame].image for frame in (a, b))
    inverse = tuple(maps[frame].inverse_depth.astype(np.float32) for frame in (a, b))
    posed = PosedSequence(
        case.name, pictures, np.arange(2.0), case.sequence.camera.K, se3.inverse(case.cam_from_world[[a, b]]), inverse
    )
    corners = cv2.goodFeaturesToTrack(pictures[0], CORNERS, QUALITY, APART)
    if corners is None:
        return None
    places = corners.reshape(1, -1, 2).astype(np.float32)
    device, rows = torch.device("cpu"), np.array([[0, 1]])
    store, frames = PictureStore(pictures, device), PosedFrames([posed], device)
    in_a = torch.from_numpy(places)
    known = frames.depths.sample(rows[:, 0], in_a)
    carried = frames.carry(rows, in_a, known)
    seen = frames.shown(rows, carried, SAME_DEPTH)
    moved = aligned(store, frames, rows, in_a, torch.where(seen, known, 0.0), AlignmentSettings())
    chosen = seen[0].numpy()
    if not chosen.any():
        return None
    own, where = (part[0].numpy()[chosen].astype(np.float64) for part in (carried.places, moved.places))
    true = _true_places(case, a, b, places[0][chosen].astype(np.float64), truth)
    distances = (own - where, true - where, own - true, where - true)
    flags = (part[0].numpy()[chosen] for part in (moved.certain, moved.contradicted))
    return (chosen.mean(), *flags, *(np.linalg.norm(difference, axis=1) for difference in distances))


def _true_places(case: Case, a: int, b: int, places: Float64, depth: np.ndarray) -> Float64:
    """Pixels (N, 2) of frame b by depth image and true poses; NaN where the depth is missing."""
    height, width = depth.shape
    column, row = np.clip(np.rint((places - 0.5) / 2), 0, (width - 1, height - 1)).astype(np.int64).T
    z = depth[row, column].astype(np.float64)
    motion = case.truth.cam_from_world[b] @ se3.inverse(case.truth.cam_from_world[a])
    points = se3.transform(motion, case.truth.unproject(places, np.where(np.isfinite(z), z, 1.0)))
    good = np.isfinite(z) & (points[:, 2] > 0)
    return np.where(good[:, None], case.truth.project(np.where(good[:, None], points, [0.0, 0.0, 1.0])), np.nan)
