"""Is an agreement more than chance? The number of false alarms of a model (Moisan and Stival 2004).

Among unrelated matches, each agrees with a fixed model with a probability that follows from the tolerance and the size
of the picture. The number of false alarms is how many models with so many inliers are expected among all that RANSAC
could have drawn from matches without any truth in them. Far under 1, the agreement is none of chance.
"""

from __future__ import annotations

import math

SIGNIFICANT = -6.0  # log10 of the number of false alarms, at most, of an agreement that is none of chance
_LN10 = math.log(10.0)


def log10_false_alarms(matches: int, inliers: int, probability: float, sample: int, models: int = 1) -> float:
    """Decimal logarithm of the expected number of models with so many inliers among unrelated matches.

    Args:
        matches: all of them, N.
        inliers: those that agree with the model, K; the sample's own are among them.
        probability: that an unrelated match agrees with a fixed model, between 0 and 1.
        sample: matches that a model is made of.
        models: that one sample can give.

    Returns:
        log10 of models (N - sample) C(N, K) C(K, sample) probability^(K - sample); infinity where K is no more than the
        sample, since any sample agrees with itself.
    """
    if not (0 < probability < 1 and 0 <= inliers <= matches):
        raise ValueError(f"probability {probability}, {inliers} of {matches} matches: not a probability or too many")
    if inliers <= sample:
        return math.inf
    tests = math.log(models) + math.log(matches - sample)
    chosen = _log_choose(matches, inliers) + _log_choose(inliers, sample)
    return (tests + chosen + (inliers - sample) * math.log(probability)) / _LN10


def line_probability(width: int, height: int, tolerance: float) -> float:
    """Largest share of a picture that lies within a tolerance of a line through it: a match to an epipolar line.

    Args:
        width, height: pixels.
        tolerance: pixels.
    """
    return min(2.0 * tolerance * math.hypot(width, height) / (width * height), 0.5)


def disc_probability(width: int, height: int, tolerance: float) -> float:
    """Share of a picture that lies within a tolerance of a point in it: a match to a projection.

    Args:
        width, height: pixels.
        tolerance: pixels.
    """
    return min(math.pi * tolerance**2 / (width * height), 0.5)


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
