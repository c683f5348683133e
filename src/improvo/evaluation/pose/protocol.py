"""The pose protocol: 3D-to-2D pose estimation (paper, "3D-to-2D Pose Estimation", Table 1).

For random frame pairs (A, B) of a sequence: match the features of A and B, lift the matched keypoints of A to 3D with
A's depth, solve for the camera of B, and compare with the true relative pose.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from improvo.evaluation.measures import PairGeometry, PoseError, relative_motion, repeated_keypoints, right_matches
from improvo.evaluation.pose.cache import FeatureCache, read_cache
from improvo.evaluation.pose.estimators import ESTIMATORS
from improvo.evaluation.pose.pairs import SequencePairs
from improvo.evaluation.settings import PoseSettings
from improvo.evaluation.sources import FeatureSource, SequenceSource
from improvo.geometry.camera import Camera
from improvo.tracking.matching import mutual_nearest_neighbours
from improvo.types import Features, Float64, Int64

CHUNK = 25  # pairs of one task


# One row per pair, frontend, estimator and shuffle.
RECORD = np.dtype(
    [
        ("sequence", np.int32),
        ("gap", np.int32),
        ("a", np.int32),
        ("b", np.int32),
        ("frontend", np.int32),
        ("estimator", np.int32),
        ("shuffle", np.int32),  # 0 is the order in which the matches came
        ("keypoints", np.int32),  # of A
        ("matches", np.int32),
        ("judged", np.int32),  # matches with trusted depth in A: those that the pose is estimated from
        ("right", np.int32),  # judged matches that agree with the true pose, within max_error_px
        ("right_strict", np.int32),  # the same within the first of right_px
        ("right_loose", np.int32),  # and within the second
        ("visible", np.int32),  # keypoints of A that are visible in B
        ("repeated", np.int32),  # of which B has a keypoint at the same place
        ("inliers", np.int32),  # of the estimator, 0 where it failed
        ("rotation_deg", np.float64),  # error; inf where no pose was found
        ("translation_m", np.float64),
    ]
)
RIGHT = ("right", "right_strict", "right_loose")
Records = NDArray[np.void]


@dataclass(frozen=True)
class PairTask:
    """Some pairs of one sequence, for all frontends: depth is decoded once."""

    source: SequenceSource
    sequence: int
    gap: int
    pairs: Int64  # (K, 2)
    b_from_a: Float64  # (K, 4, 4)
    caches: tuple[str, ...]  # feature cache of each frontend
    settings: PoseSettings


def pair_tasks(
    sources: list[SequenceSource], sequences: list[SequencePairs], caches: list[list[Path]], settings: PoseSettings
) -> list[PairTask]:
    """All pairs in chunks.

    Args:
        sources: of the sequences.
        sequences: their pairs.
        caches: folders of features, by sequence, then frontend.
        settings: of the protocol.
    """
    tasks = []
    for number, (source, sequence) in enumerate(zip(sources, sequences, strict=True)):
        for gap, pairs in sequence.pairs.items():
            motion = relative_motion(sequence.world_from_cam, pairs)
            folders = tuple(str(folder) for folder in caches[number])
            for start in range(0, len(pairs), CHUNK):
                part = slice(start, start + CHUNK)
                tasks.append(PairTask(source, number, gap, pairs[part], motion[part], folders, settings))
    return tasks


def evaluate_pairs(task: PairTask) -> Records:
    """Records of all pairs of a task, frontend by frontend, estimator by estimator."""
    sequence, settings = task.source.open(), task.settings
    caches = [_opened(folder, (Path(folder) / "index.json").stat().st_mtime_ns) for folder in task.caches]
    records = []
    for (a, b), b_from_a in zip(task.pairs, task.b_from_a, strict=True):
        depth_a = sequence.depth(int(a))
        assert depth_a is not None  # pairs are drawn among frames with depth
        geometry = PairGeometry(
            sequence.camera, b_from_a, depth_a, sequence.depth(int(b)), settings.depth_sampling, settings.depth_edge
        )
        for number, cache in enumerate(caches):
            rows = evaluate_pair(geometry, cache[int(a)], cache[int(b)], settings)
            rows["sequence"], rows["gap"], rows["a"], rows["b"] = task.sequence, task.gap, a, b
            rows["frontend"] = number
            records.append(rows)
    return np.concatenate(records)


def evaluate_pair(
    geometry: PairGeometry, features_a: Features, features_b: Features, settings: PoseSettings
) -> Records:
    """The records of one image pair and one frontend: estimator by estimator, shuffle by shuffle.

    Args:
        geometry: the truth about the pair.
        features_a, features_b: of the two images.
        settings: of the protocol.
    """
    rows = np.zeros(len(settings.estimators) * settings.shuffles, RECORD)
    matches = mutual_nearest_neighbours(features_a, features_b, max_distance=None)
    points = geometry.points_a(features_a.keypoints[matches[:, 0]])
    pixels = features_b.keypoints[matches[:, 1]].astype(np.float64)
    has_depth = np.isfinite(points[:, 2])
    points, pixels = points[has_depth], pixels[has_depth]
    rows["keypoints"], rows["matches"], rows["judged"] = len(features_a), len(matches), len(points)
    for name, limit in zip(RIGHT, (settings.max_error_px, *settings.right_px), strict=True):
        rows[name] = right_matches(geometry, points, pixels, limit).sum()
    rows["visible"], rows["repeated"] = repeated_keypoints(
        geometry, features_a.keypoints, features_b.keypoints, settings.max_error_px
    )
    orders = shuffled_orders(len(points), settings.shuffles, settings.seed)
    for row, (number, shuffle) in enumerate(itertools.product(range(len(settings.estimators)), range(len(orders)))):
        order = orders[shuffle]
        name = settings.estimators[number]
        error, inliers = solve(name, points[order], pixels[order], geometry.camera, geometry.b_from_a, settings.seed)
        rows["estimator"][row], rows["shuffle"][row], rows["inliers"][row] = number, shuffle, inliers
        rows["rotation_deg"][row], rows["translation_m"][row] = error.rotation_deg, error.translation_m
    return rows


def shuffled_orders(matches: int, shuffles: int, seed: int) -> list[Int64]:
    """Orders in which the solvers get the matches: as they are, then random ones, the same for the same number.

    Args:
        matches: their number.
        shuffles: orders wanted.
        seed: of the random ones.
    """
    rng = np.random.default_rng([seed, matches])
    return [np.arange(matches), *(rng.permutation(matches) for _ in range(shuffles - 1))]


def solve(
    estimator: str, points_a: Float64, pixels_b: Float64, camera: Camera, b_from_a: Float64, seed: int
) -> tuple[PoseError, int]:
    """Error of the pose from matches, and its inliers; a failure is an error of inf and 0 inliers.

    Args:
        estimator: name of the solver.
        points_a: (N, 3) in the camera of A.
        pixels_b: (N, 2) in B.
        camera: of both.
        b_from_a: (4, 4) true motion.
        seed: of the solver.
    """
    estimate = ESTIMATORS[estimator](points_a, pixels_b, camera, seed)
    if estimate is None:
        return PoseError.of_failure(), 0
    return PoseError.between(b_from_a, estimate.cam_from_world), int(estimate.inliers.sum())


@lru_cache(maxsize=64)
def _opened(folder: str, modified: int) -> FeatureCache:
    cache = read_cache(Path(folder))
    assert cache is not None
    return cache


@dataclass(frozen=True)
class ExtractionTask:
    """Some frames of one sequence, for one frontend."""

    source: SequenceSource
    features: FeatureSource
    frames: tuple[int, ...]


def extract(task: ExtractionTask) -> dict[int, Any]:
    """Features of each frame; None for a frame that cannot be decoded."""
    from improvo.errors import InputError

    sequence = task.source.open()
    result: dict[int, Any] = {}
    for index in task.frames:
        try:
            frame = sequence[index]
        except InputError:
            result[index] = None
            continue
        result[index] = task.features.features(sequence, frame)
    return result
