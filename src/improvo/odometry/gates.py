"""What several parts of the robust mode measure by, each number once.

Pixels follow from one tolerance (`OdometrySettings.tolerance`): a right match lies within it of its epipolar line, a
right observation of a map point within twice that of its projection, and what is over three times that off a motion is
none of its noise. Counts follow from the points that a map needs (`start.min_points`), and percents from the error
that a segment may have (`verdict.max_error`).
"""

from __future__ import annotations

FEWEST = 12  # right points fix a pose, a scale or a lens; fewer agree by chance
LARGE_PART = 0.4  # of the matches, the picture or the keypoints: what is smaller may be a mover, or repeated texture
FAR = 3.0  # times the tolerance: a match so far off a motion is none of its noise, and one that moved so far did move
SAME_TURN_DEG = 5.0  # between two rotations that are to be one
SAME_PATH = 0.5  # of the error that a segment may have: two paths that differ by less are one
SAME_SCALE = 0.1  # of the logarithm, between two scales that are to be one
MIN_PARALLAX_DEG = 1.0  # of a point, for its depth to be more than noise
MEMORY_FRAMES = 60  # for which points without a track are searched, and after which a map is trusted
STEP_FRAMES = 5  # between two checks, and between two views that are compared: a slow world moves by then
FEATURES = 600  # of each view, the strongest, that a check matches afresh; more cost time and change nothing


def gate(tolerance: float) -> float:
    """Pixels that a right observation may be off its projection: two coordinates, and the point's own error."""
    return 2.0 * tolerance
