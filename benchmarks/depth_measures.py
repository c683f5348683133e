"""How right depth maps are, and the correspondences that follow from them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from depth_cases import Case
from improvo.depth import DepthMap
from improvo.geometry import se3
from improvo.types import Float64

FAR_OFF = 0.05  # relative error
FAR_OFF_PIXELS = 8.0
AGREE = 0.05  # relative difference of the depths of a point in two maps
EDGE = 15.0  # pixels; a SIFT match that neither the maps nor the truth come so near to is wrong
Maps = dict[int, DepthMap]


@dataclass(frozen=True)
class Accuracy:
    """Of all maps, under one scale for the whole recording."""

    known: float  # share of the pixels
    median: float  # relative error
    far_off: float  # share over FAR_OFF
    frame_median: float  # likewise, with a scale for each frame
    frame_far_off: float


def accuracy(case: Case, maps: Maps) -> Accuracy:
    """Against the depth images, where both know a depth."""
    ratios = []
    for frame, depth_map in maps.items():
        height, width = depth_map.depth.shape
        truth = case.truth.depth(frame, (width, height))
        if truth is not None:
            both = (depth_map.depth > 0) & np.isfinite(truth)
            ratios.append((depth_map.depth[both] / truth[both]).astype(np.float64))
    ratios = [ratio for ratio in ratios if len(ratio) > 100]
    together = np.concatenate(ratios)
    errors = np.abs(together / np.median(together) - 1)
    by_frame = np.concatenate([np.abs(ratio / np.median(ratio) - 1) for ratio in ratios])
    return Accuracy(
        float(np.mean([depth_map.known for depth_map in maps.values()])),
        float(np.median(errors)),
        float((errors > FAR_OFF).mean()),
        float(np.median(by_frame)),
        float((by_frame > FAR_OFF).mean()),
    )


@dataclass(frozen=True)
class Correspondences:
    """Between frames so far apart, in pixels of the frames."""

    gap: int
    pixels: float  # share of the map's pixels that have one
    median: float  # pixels from where depth image and true poses put them
    far_off: float  # share over FAR_OFF_PIXELS
    matches: int  # SIFT matches at such pixels
    own_to_match: float  # pixels, median: from the correspondence to the match
    truth_to_match: float  # likewise, from where the truth puts it


def correspondences(case: Case, maps: Maps, gap: int, every: int) -> Correspondences | None:
    """Of each `every`-th frame with the one `gap` later; None without a pair."""
    errors, shares, own, true = [], [], [], []
    for a in range(0, len(case.sequence) - gap, every):
        b = a + gap
        poses = case.cam_from_world[[a, b]], case.truth.cam_from_world[[a, b]]
        if a not in maps or b not in maps or not np.isfinite(poses).all() or case.segment[a] != case.segment[b]:
            continue
        found = _pair(case, maps, a, b)
        if found is not None:
            estimated, expected = found
            known = np.isfinite(estimated).all(axis=-1)
            both = known & np.isfinite(expected).all(axis=-1)
            errors.append(np.linalg.norm(estimated[both] - expected[both], axis=-1))
            shares.append(known.mean())
            own_errors, true_errors = _matched(case, a, b, estimated, expected)
            own.append(own_errors)
            true.append(true_errors)
    if not errors:
        return None
    all_errors, own_errors, true_errors = np.concatenate(errors), np.concatenate(own), np.concatenate(true)
    if len(all_errors) == 0:
        return None
    return Correspondences(
        gap,
        float(np.mean(shares)),
        float(np.median(all_errors)),
        float((all_errors > FAR_OFF_PIXELS).mean()),
        len(own_errors),
        float(np.median(own_errors)) if len(own_errors) else np.nan,
        float(np.median(true_errors)) if len(own_errors) else np.nan,
    )


def _pair(case: Case, maps: Maps, a: int, b: int) -> tuple[Float64, Float64] | None:
    """Where each pixel of map a falls in frame b, (h, w, 2) each: by the maps, and by the truth; NaN where unknown.

    A pixel has a place by the maps only where map b has the same depth there.
    """
    first, second = maps[a], maps[b]
    height, width = first.depth.shape
    truth = case.truth.depth(a, (width, height))
    if truth is None:
        return None
    rows, columns = np.nonzero(first.depth > 0)
    pixels = np.stack([columns, rows, np.ones(len(rows))])
    b_from_a = case.cam_from_world[b] @ se3.inverse(case.cam_from_world[a])
    points = se3.transform(b_from_a, (np.linalg.inv(first.K) @ pixels * first.depth[rows, columns]).T)
    projected = points @ first.K.T
    places = projected[:, :2] / projected[:, 2:]
    column, row = np.clip(np.rint(places), 0, (width - 1, height - 1)).astype(np.int64).T
    there = second.depth[row, column]
    agrees = (points[:, 2] > 0) & (there > 0) & (np.abs(places - np.stack([column, row], axis=1)).max(axis=1) <= 0.51)
    agrees &= np.abs(points[:, 2] - there) <= AGREE * there
    estimated, expected = np.full((height, width, 2), np.nan), np.full((height, width, 2), np.nan)
    estimated[rows[agrees], columns[agrees]] = 2 * places[agrees] + 0.5
    rows, columns = np.nonzero(np.isfinite(truth))
    frame_pixels = 2.0 * np.stack([columns, rows], axis=1) + 0.5
    true_points = case.truth.unproject(frame_pixels, truth[rows, columns].astype(np.float64))
    true_b_from_a = case.truth.cam_from_world[b] @ se3.inverse(case.truth.cam_from_world[a])
    moved = se3.transform(true_b_from_a, true_points)
    front = moved[:, 2] > 0
    expected[rows[front], columns[front]] = case.truth.project(moved[front])
    return estimated, expected


def _matched(case: Case, a: int, b: int, estimated: Float64, expected: Float64) -> tuple[Float64, Float64]:
    """Pixels from SIFT matches to the correspondences of the maps, and to those of the truth, at the same keypoints."""
    (points_a, points_b), (height, width) = _sift_matches(case, a, b), estimated.shape[:2]
    column, row = np.clip(np.rint((points_a - 0.5) / 2), 0, (width - 1, height - 1)).astype(np.int64).T
    offset = points_a - (2.0 * np.stack([column, row], axis=1) + 0.5)  # from the middle of the map's pixel
    own = np.linalg.norm(estimated[row, column] + offset - points_b, axis=1)
    true = np.linalg.norm(expected[row, column] + offset - points_b, axis=1)
    right = np.isfinite(own) & np.isfinite(true) & (np.minimum(own, true) < EDGE)
    return own[right], true[right]


def _sift_matches(case: Case, a: int, b: int) -> tuple[Float64, Float64]:
    """Matches (N, 2) of two frames that pass the ratio test and lie on their own epipolar lines."""
    sift = cv2.SIFT_create(3000)
    (keys_a, words_a), (keys_b, words_b) = (sift.detectAndCompute(case.sequence[f].image, None) for f in (a, b))
    nothing = np.zeros((0, 2))
    if words_a is None or words_b is None or min(len(keys_a), len(keys_b)) < 2:
        return nothing, nothing
    pairs = [m for m, n in cv2.BFMatcher().knnMatch(words_a, words_b, 2) if m.distance < 0.75 * n.distance]
    if len(pairs) < 30:
        return nothing, nothing
    points_a = np.array([keys_a[m.queryIdx].pt for m in pairs])
    points_b = np.array([keys_b[m.trainIdx].pt for m in pairs])
    fundamental, inliers = cv2.findFundamentalMat(points_a, points_b, cv2.USAC_MAGSAC, 1.0, 0.999, 5000)
    kept = np.zeros(len(pairs), bool) if fundamental is None else inliers.ravel() > 0
    return points_a[kept], points_b[kept]
