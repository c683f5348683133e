"""How good a frontend's matches are where there is no ground truth: by one fixed run of the odometry.

The run's poses and depth maps stand for the truth, and they are the same for every frontend that is compared. A match
of two frames is right if the point of A lands, by that run, near its match in B. Success of the pose is that of the
paper's protocol, against the run's relative pose; the run has no metric scale, so that its translation is measured in
median depths of A.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from improvo.config import check_seed
from improvo.errors import ConfigError, InputError
from improvo.evaluation.measures import PairGeometry, relative_motion
from improvo.evaluation.pose.pairs import overlapping
from improvo.evaluation.pose.protocol import Records, evaluate_pair
from improvo.evaluation.pose.results import share
from improvo.evaluation.settings import DEFAULT_ESTIMATORS, PoseSettings
from improvo.evaluation.statistics import Bootstrap, below
from improvo.geometry.camera import Camera
from improvo.types import Features, Float32, Float64, Int64


@dataclass(frozen=True)
class SelfTruthSettings:
    """How matches and poses are held against the fixed run."""

    pairs: int = 200  # per gap, evenly spread
    max_keypoints: int = 500
    right_px: tuple[float, float] = (3.0, 8.0)  # a match is right strictly below
    shuffles: int = 8  # orders of the matches that the solvers get
    estimators: tuple[str, ...] = DEFAULT_ESTIMATORS
    max_rotation_deg: float = 5.0  # success is strictly below
    max_translation: float = 0.025  # in median depths of A: 5 cm at 2 m; success is strictly below
    min_matches: int = 4  # with depth in A; a pair of frames with fewer counts as none right
    seed: int = 0  # of the shuffles, the solvers and the intervals
    resamples: int = 1000  # of the bootstrap
    confidence: float = 0.95  # of the intervals

    def __post_init__(self) -> None:
        if min(self.pairs, self.shuffles, self.resamples, self.min_matches) < 1 or self.max_keypoints < 4:
            raise ConfigError("pairs, shuffles, resamples and min_matches must be at least 1, max_keypoints at least 4")
        limits = (*self.right_px, self.max_rotation_deg, self.max_translation)
        if not (all(limit > 0 for limit in limits) and 0 < self.confidence < 1):
            raise ConfigError("thresholds must be positive, and confidence between 0 and 1")
        check_seed(self.seed)


@dataclass(frozen=True)
class FixedRun:
    """Poses and depth of one run of the odometry over some frames."""

    camera: Camera  # pinhole, of the frames
    world_from_cam: Float64  # (N, 4, 4), NaN where there is no pose
    segment: Int64  # (N,) poses of different segments do not share a world; -1 without pose
    has_depth: NDArray[np.bool_]  # (N,) whether a frame has a depth map
    depth: Callable[[int], Float32]  # frame -> (h, w) in the unit of the poses, 0 or NaN where unknown; any resolution


@dataclass(frozen=True)
class PairScores:
    """What each pair of frames says about one frontend; row k is the same pair for every frontend."""

    gap: int
    pairs: Int64  # (K, 2) frames A and B
    matches: Int64  # (K,) whose keypoint in A has depth
    values: dict[str, Float64]  # name -> (K,), each between 0 and 1

    def means(self) -> dict[str, float]:
        """The mean of every value over the pairs."""
        return {name: float(values.mean()) for name, values in self.values.items()}


def choose_pairs(run: FixedRun, gap: int, count: int) -> Int64:
    """Pairs (K, 2) of frames of one segment, `gap` apart, the first with a depth map; evenly spread.

    Args:
        run: the fixed run.
        gap: frames between the two.
        count: pairs wanted, at most.
    """
    posed = np.isfinite(run.world_from_cam).all(axis=(1, 2)) & (run.segment >= 0)
    first = np.arange(max(len(posed) - gap, 0))
    together = posed[first] & posed[first + gap] & (run.segment[first] == run.segment[first + gap])
    first = first[together & run.has_depth[first]]
    spread = np.unique(np.linspace(0, len(first) - 1, min(count, len(first))).round().astype(np.int64))
    return np.stack([first[spread], first[spread] + gap], axis=1)


def score_pairs(
    run: FixedRun,
    features: Callable[[int], Features],
    pairs: Int64,
    settings: SelfTruthSettings,
    tick: Callable[[], None] = lambda: None,
) -> PairScores:
    """Hold a frontend's matches against the fixed run.

    Args:
        run: the same for all frontends that are compared.
        features: frame -> its features, the best first.
        pairs: (K, 2) of `choose_pairs`, the same for all frontends, all one gap apart.
        settings: thresholds.
        tick: called after every pair.

    Returns:
        Of each pair `right_3px` and `right_8px` (shares of right matches) and, for each solver,
        `rotation_SOLVER`, `translation_SOLVER` (shares of the shuffles with success).

    Raises:
        InputError: no pair.
    """
    if len(pairs) == 0:
        raise InputError("there is no pair of frames with poses and depth; take smaller gaps or a longer recording")
    motions = relative_motion(run.world_from_cam, pairs)
    protocol = PoseSettings(
        gaps=(int(pairs[0, 1] - pairs[0, 0]),),
        max_keypoints=settings.max_keypoints,
        estimators=settings.estimators,
        seed=settings.seed,
        shuffles=settings.shuffles,
        right_px=settings.right_px,
    )
    matches: list[int] = []
    rows: list[dict[str, float]] = []
    for (a, b), motion in zip(pairs.tolist(), motions, strict=True):
        depth = _depth_map(run, a)
        geometry = PairGeometry(run.camera, motion, depth, None)
        of_a, of_b = (features(frame).best(settings.max_keypoints) for frame in (a, b))
        found = evaluate_pair(geometry, of_a, of_b, protocol)
        matches.append(int(found["judged"][0]))
        known = depth[np.isfinite(depth)]
        rows.append(_values(found, float(np.median(known)) if len(known) else 0.0, settings))
        tick()
    values = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return PairScores(protocol.gaps[0], np.array(pairs, np.int64), np.array(matches, np.int64), values)


def compare(first: PairScores, second: PairScores, settings: SelfTruthSettings) -> dict[str, dict[str, Any]]:
    """What the second frontend adds to the first, pair by pair.

    Args:
        first, second: scores of the same pairs.
        settings: of the intervals.

    Returns:
        For each value `first`, `second`, `difference` (means), and the `interval` of the difference by a paired
        bootstrap over blocks of neighbouring pairs.

    Raises:
        InputError: the pairs are not the same.
    """
    return compare_gaps([first], [second], settings)


def compare_gaps(
    first: Sequence[PairScores], second: Sequence[PairScores], settings: SelfTruthSettings
) -> dict[str, dict[str, Any]]:
    """As `compare`, over the pairs of several gaps or recordings together, each of them with the same weight.

    Args:
        first, second: scores of the two frontends, gap by gap.
        settings: of the intervals.
    """
    same = len(first) == len(second) > 0 and all(
        np.array_equal(one.pairs, other.pairs) for one, other in zip(first, second, strict=True)
    )
    if not same:
        raise InputError("the two frontends were not scored on the same pairs; score both again")
    bootstraps = [
        Bootstrap(
            len(one.pairs), settings.seed + number, settings.resamples, settings.confidence, overlapping(one.pairs)
        )
        for number, one in enumerate(first)
    ]
    found: dict[str, dict[str, Any]] = {}
    for name in first[0].values:
        before, after = (float(np.mean([one.values[name].mean() for one in scores])) for scores in (first, second))
        differences = [other.values[name] - one.values[name] for one, other in zip(first, second, strict=True)]
        resampled = np.mean([b.means(d) for b, d in zip(bootstraps, differences, strict=True)], axis=0)
        low, high = bootstraps[0].percentiles(resampled)
        found[name] = {"first": before, "second": after, "difference": after - before, "interval": [low, high]}
    return found


def _values(records: Records, median_depth: float, settings: SelfTruthSettings) -> dict[str, float]:
    enough = records["judged"][:1] >= settings.min_matches
    strict, loose = (f"right_{limit:g}px" for limit in settings.right_px)
    values = {
        strict: float(share(records["right_strict"][:1] * enough, records["judged"][:1])[0]),
        loose: float(share(records["right_loose"][:1] * enough, records["judged"][:1])[0]),
    }
    for number, solver in enumerate(settings.estimators):
        own = records[records["estimator"] == number]
        values[f"rotation_{solver}"] = _mean(below(own["rotation_deg"], settings.max_rotation_deg))
        values[f"translation_{solver}"] = _mean(below(own["translation_m"], settings.max_translation * median_depth))
    return values


def _mean(success: NDArray[np.bool_]) -> float:
    return float(success.mean())


def _depth_map(run: FixedRun, frame: int) -> Float32:
    """The map with NaN where it is unknown."""
    depth = run.depth(frame)
    return np.where(depth > 0, depth, np.nan).astype(np.float32)
