"""Where the search for the lens starts: the field of view and distortion under which pairs of frames agree best."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from improvo.geometry.camera import Camera
from improvo.geometry.epipolar import sampson_errors
from improvo.geometry.ransac import Ransac, relative_pose
from improvo.self_calibration.lens import Lens, lens_with_fov
from improvo.self_calibration.raw_features import Piece
from improvo.tracking.matching import distance_threshold, match_units, unit_descriptors
from improvo.types import Float64

FOVS = (30.0, 38.0, 47.0, 55.0, 63.0, 72.0, 82.0, 93.0, 105.0, 118.0)
DISTORTIONS = (("brown", 0.0), ("brown", -0.15), ("brown", -0.3), ("fisheye", 0.0))
_GAPS = (3, 6, 12, 24, 48)  # frames
_MOTION = 0.12  # of the median match, as a share of the width, that tells most
_MIN_MATCHES = 80
_MAX_MATCHES = 400
_MAX_ERROR = 1.5  # pixels
_LEAST_FISHEYE = 80.0  # degrees; narrower lenses differ too little from the other model


@dataclass(frozen=True)
class Pair:
    """Matches of two frames, raw pixels (N, 2) each."""

    a: Float64
    b: Float64


@dataclass(frozen=True)
class Guess:
    """A lens, and how well pairs of frames agree with it."""

    lens: Lens
    score: float  # share of the matches that agree, soft; larger is better


def far_pairs(pieces: list[Piece], width: int, count: int, max_distance: float, seed: int) -> list[Pair]:
    """Pairs of frames spread over the pieces, moved by about an eighth of the picture.

    Args:
        pieces: with their features.
        width: of the pictures, pixels.
        count: of pairs, at most.
        max_distance: of matched descriptors.
        seed: of the choice of matches.
    """
    rng = np.random.default_rng(seed)
    per_piece = max(1, count // max(len(pieces), 1))
    pairs = []
    for piece in pieces:
        frames = len(piece.features)
        for first in np.unique(np.linspace(0, max(frames - 1 - _GAPS[2], 0), per_piece).astype(int)).tolist():
            best: tuple[float, Pair] | None = None
            for gap in _GAPS:
                if first + gap >= frames:
                    break
                pair = _matched(piece, first, first + gap, max_distance)
                if len(pair.a) < _MIN_MATCHES:
                    break
                motion = float(np.median(np.linalg.norm(pair.a - pair.b, axis=1))) / width
                off = abs(np.log(max(motion, 1e-6) / _MOTION))
                if best is None or off < best[0]:
                    best = off, pair
            if best is not None:
                rows = rng.permutation(len(best[1].a))[:_MAX_MATCHES]
                pairs.append(Pair(best[1].a[rows], best[1].b[rows]))
    return pairs


def guesses(
    pairs: list[Pair], width: int, height: int, model: str, seed: int, progress: Callable[[int, int], None]
) -> list[Guess]:
    """All lenses of the sweep, best first.

    Args:
        pairs: from `far_pairs`.
        width: of the pictures, pixels.
        height: pixels.
        model: of the distortion; `auto` tries all.
        seed: of every RANSAC.
        progress: told how many of how many are tried.
    """
    candidates = [
        lens_with_fov(fov, width, height, kind, k1)
        for kind, k1 in DISTORTIONS
        for fov in FOVS
        if model in ("auto", kind) and not (kind == "fisheye" and fov < _LEAST_FISHEYE)
    ]
    found = []
    for number, lens in enumerate(candidates):
        found.append(Guess(lens, agreement(pairs, lens, seed)))
        progress(number + 1, len(candidates))
    return sorted(found, key=lambda guess: -guess.score)


def agreement(pairs: list[Pair], lens: Lens, seed: int) -> float:
    """How well pairs agree with a lens: the mean over all of 1 - (error / limit)^2, at least 0."""
    return float(np.mean([_agreement(pair, lens, seed) for pair in pairs]))


def _agreement(pair: Pair, lens: Lens, seed: int) -> float:
    """Mean over the matches of 1 - (error / limit)^2, at least 0."""
    focal = float(lens.values[0])
    camera = Camera(lens.width, lens.height, focal, focal, 0.0, 0.0)
    a, b = lens.rays(pair.a) * focal, lens.rays(pair.b) * focal
    known = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    if known.sum() < 20:
        return 0.0
    found = relative_pose(a[known], b[known], camera, Ransac(_MAX_ERROR, seed, 100, 300))
    errors = sampson_errors(found.pose, camera, a[known], b[known])
    errors = np.where(found.inliers, errors, np.inf)
    return float(np.maximum(1.0 - (errors / _MAX_ERROR) ** 2, 0.0).sum() / len(pair.a))


def _matched(piece: Piece, first: int, second: int, max_distance: float) -> Pair:
    a, b = piece.features[first], piece.features[second]
    rows = match_units(unit_descriptors(a), unit_descriptors(b), distance_threshold(a, max_distance))
    return Pair(a.keypoints[rows[:, 0]].astype(np.float64), b.keypoints[rows[:, 1]].astype(np.float64))
