"""How many poses as good as this one would chance give? A-contrario: the number of false alarms (Moisan, Stival 2004).

Under the background model every match is wrong and its error is uniform over the picture. A pose with k of n matches
within a threshold is meaningful if, over all the poses that could have been tried, chance gives far fewer than one
such. The number replaces a least count and a least share of inliers, which depend on each other and on the threshold.
"""

from __future__ import annotations

import math

from improvo.geometry.camera import Camera

_SAMPLE = 3  # matches that determine a pose
_SOLUTIONS = 4  # poses that one sample has, at most


def log10_false_alarms(inliers: int, matches: int, threshold: float, camera: Camera) -> float:
    """Decimal logarithm of the expected number of equally good poses by chance.

    Args:
        inliers: matches within the threshold.
        matches: all of them.
        threshold: pixels.
        camera: gives the size of the picture.

    Returns:
        Far below 0 where the pose cannot be chance; positive infinity where the inliers determine nothing.
    """
    if inliers <= _SAMPLE or matches <= _SAMPLE:
        return math.inf
    chance = min(math.pi * threshold**2 / (camera.width * camera.height), 1.0)
    choices = _log_choose(matches, inliers) + _log_choose(inliers, _SAMPLE)
    tested = math.log((matches - _SAMPLE) * _SOLUTIONS)
    return (tested + choices + (inliers - _SAMPLE) * math.log(chance)) / math.log(10.0)


def _log_choose(n: int, k: int) -> float:
    return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
