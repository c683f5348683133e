"""How good a frontend is where nothing is known but the video: which of its matches survive a wide baseline.

Two frames some way apart are matched by mutual nearest neighbours; the matches that agree with one epipolar geometry of
the known camera are those that survived. A better frontend has more of them on the same pairs. Chance has some too: on
pictures of different rooms up to 14 matches agree with some geometry, so a pair with fewer than 15 counts as none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from improvo.errors import InputError
from improvo.evaluation.settings import SurvivalSettings
from improvo.frontend import Frontend
from improvo.frontend.masking import features_of
from improvo.geometry.camera import Camera
from improvo.sequences import Sequence as FrameSequence
from improvo.tracking.matching import mutual_nearest_neighbours
from improvo.types import Features, Int64

_MIN_MATCHES = 5  # of the five-point method


@dataclass(frozen=True)
class Survival:
    """The pairs of one sequence and gap; row k is the same pair for every frontend."""

    gap: int
    pairs: Int64  # (K, 2) frames A and B = A + gap
    keypoints: Int64  # (K,) of A
    matches: Int64  # (K,) mutual nearest neighbours
    agreeing: Int64  # (K,) of those, with one epipolar geometry; 0 where too few to tell from chance


def usable_gaps(lengths: Sequence[int], settings: SurvivalSettings) -> tuple[int, ...]:
    """The gaps that the longest of sequences of these lengths has enough pairs for.

    Where it has none of them, a quarter, a half and three quarters of its length stand in.
    """
    longest = max(lengths, default=0)
    gaps = tuple(gap for gap in settings.gaps if longest - gap >= settings.min_pairs)
    return gaps or tuple(sorted({longest * part // 4 for part in (1, 2, 3)} - {0}))


def spread_pairs(frames: int, gap: int, count: int) -> Int64:
    """Pairs (K, 2) of frames A and A + gap, evenly spread over a sequence.

    Args:
        frames: length of the sequence.
        gap: frames between the two.
        count: pairs wanted, at most.
    """
    possible = max(frames - gap, 0)
    first = np.unique(np.linspace(0, possible - 1, min(count, possible)).round().astype(np.int64))
    return np.stack([first, first + gap], axis=1)


def surviving_matches(
    sequence: FrameSequence,
    frontend: Frontend,
    gaps: Sequence[int],
    settings: SurvivalSettings,
    tick: Callable[[], None] = lambda: None,
) -> list[Survival]:
    """Count the surviving matches of one sequence, gap by gap; pairs with a frame that cannot be read are left out.

    Args:
        sequence: any recording; neither depth nor poses are used.
        frontend: only its best `settings.max_keypoints` keypoints are used.
        gaps: frames between the two images of a pair.
        settings: of the protocol.
        tick: called after every pair.
    """
    wanted = {gap: spread_pairs(len(sequence), gap, settings.pairs) for gap in gaps}
    features: dict[int, Features] = {}
    for row in sorted({int(row) for pairs in wanted.values() for row in pairs.ravel()}):
        try:
            frame = sequence[row]
        except InputError:
            continue
        found = features_of(frontend, frame)
        features[row] = found.take(np.arange(min(len(found), settings.max_keypoints)))
    results = []
    for gap, pairs in wanted.items():
        readable = np.array([int(a) in features and int(b) in features for a, b in pairs], np.bool_)
        counts = []
        for a, b in pairs[readable]:
            first, second = features[int(a)], features[int(b)]
            counts.append((len(first), *agreeing_matches(first, second, sequence.camera, settings)))
            tick()
        columns = np.array(counts, np.int64).reshape(-1, 3)
        results.append(Survival(gap, pairs[readable], columns[:, 0], columns[:, 1], columns[:, 2]))
    return results


def agreeing_matches(a: Features, b: Features, camera: Camera, settings: SurvivalSettings) -> tuple[int, int]:
    """The number of mutual nearest neighbours, and of those that agree with the epipolar geometry most agree with.

    Args:
        a, b: features of the two images.
        camera: of both.
        settings: of the robust solver.
    """
    from improvo.geometry.two_view import Ransac, relative_pose

    matches = mutual_nearest_neighbours(a, b, max_distance=None)
    if len(matches) < _MIN_MATCHES:
        return len(matches), 0
    ransac = Ransac(settings.max_epipolar_error, settings.seed, max_iterations=settings.max_iterations)
    pixels_a = a.keypoints[matches[:, 0]].astype(np.float64)
    pixels_b = b.keypoints[matches[:, 1]].astype(np.float64)
    agreeing = int(relative_pose(pixels_a, pixels_b, camera, ransac).inliers.sum())
    return len(matches), agreeing if agreeing >= settings.min_agreeing else 0
