"""Is what two keyframes should both see seen by both? A place that only looks the same leaves most of it unexplained.

Where texture repeats, or a place is found again after a turn, a pose can agree with a few dozen matches and be wrong.
Its reprojection errors are small, since only what agrees is kept, and so are the changes of scale that parts of the
evidence make. But a pose also says what else must be in the picture. At the right place most points that either of two
successive keyframes sees, and that lie in the picture of the other, are seen by the other, too; at a wrong one only
those that it was chosen by. How many that are depends on the frontend, on noise and on what stands in between, so each
gap is compared with the other gaps of its segment. A keyframe that sees little, in a flash or under a logo that was not
known yet, is no leap: the little that it sees is seen from the other one, too, so of the two looks the better one
counts; and of a blurred one those before and after it see the same again. Photographs that are taken from far apart
tell nothing: from another side, things look otherwise and hide others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from improvo.geometry import se3
from improvo.geometry.camera import Camera
from improvo.odometry.gates import FEWEST, LARGE_PART
from improvo.odometry.verdict.evidence_window import EvidenceKeyframe
from improvo.types import Float64, Mask

_MARGIN = 0.03  # of the picture's width: nearer to its border, frontends find no keypoints
_FEW_GAPS = 6  # fewer tell nothing of what is usual
_FAR_APART_DEG = 5.0  # usual parallax between keyframes: 1 to 3 in videos, 11 in photographs around a thing


@dataclass(frozen=True)
class SeenAgain:
    """What one keyframe sees of another one's points, across a gap between two successive ones.

    Attributes:
        frames: of the two successive ones.
        expected: observations of the one that lie in the picture of the other.
        found: of these, those whose point the other observes.
        parallax_deg: angle between the rays from both to what is expected, median.
    """

    frames: tuple[int, int]
    expected: int
    found: int
    parallax_deg: float = 0.0

    @property
    def tells(self) -> bool:
        """Whether enough is expected for a share."""
        return self.expected >= FEWEST

    @property
    def share(self) -> float:
        """Of what is expected, what is found; 0 where nothing is expected."""
        return self.found / max(self.expected, 1)

    def or_better(self, other: SeenAgain) -> SeenAgain:
        """Of two looks across this gap the one that finds the larger share, if it tells."""
        better = other.tells and (not self.tells or other.share > self.share)
        return replace(other, frames=self.frames) if better else self


def seen_again(before: EvidenceKeyframe, after: EvidenceKeyframe, xyz: Float64, camera: Camera) -> SeenAgain:
    """What two keyframes see of each other's points; of both looks the one that finds the larger share.

    Args:
        before: the earlier one.
        after: the later one.
        xyz: (P, 3) points of the map.
        camera: pinhole, of both.
    """
    frames = before.frame_index, after.frame_index
    centers = [se3.inverse(keyframe.cam_from_world)[:3, 3] for keyframe in (before, after)]
    looks = []
    for seer, other in ((before, after), (after, before)):
        points = seer.points[_inside(se3.transform(other.cam_from_world, xyz[seer.points]), camera)]
        angles = _angle_deg(xyz[points] - centers[0], xyz[points] - centers[1])
        parallax = float(np.median(angles)) if len(angles) else 0.0
        looks.append(SeenAgain(frames, len(points), int(np.isin(points, other.points).sum()), parallax))
    return looks[0].or_better(looks[1])


def looked_again(gaps: list[SeenAgain], keyframes: Sequence[EvidenceKeyframe], xyz: Float64, camera: Camera) -> None:
    """A keyframe more: what it and the two before it see of each other's points, by the gaps between them.

    Args:
        gaps: of the segment, in temporal order; the new one is appended, and what is better known replaced.
        keyframes: the last ones of the segment, the new one last.
        xyz: (P, 3) points of the map.
        camera: pinhole, of all.
    """
    if len(keyframes) < 2:
        return
    gaps.append(seen_again(keyframes[-2], keyframes[-1], xyz, camera))
    if len(keyframes) > 2:
        wider = seen_again(keyframes[-3], keyframes[-1], xyz, camera)
        gaps[-2:] = [gap.or_better(wider) for gap in gaps[-2:]]


def leaps(gaps: Sequence[SeenAgain]) -> tuple[SeenAgain, ...]:
    """Gaps across which much less is seen again than is usual in their segment, in temporal order.

    Args:
        gaps: of a segment, those between all successive keyframes.
    """
    telling = [gap for gap in gaps if gap.tells]
    if len(telling) < _FEW_GAPS or np.median([gap.parallax_deg for gap in telling]) > _FAR_APART_DEG:
        return ()
    usual = float(np.median([gap.share for gap in telling]))
    return tuple(gap for gap in telling if gap.share < LARGE_PART * usual)


def _inside(in_camera: Float64, camera: Camera) -> Mask:
    """(N,) whether points (N, 3) lie before the camera and well inside its picture."""
    front = in_camera[:, 2] > 1e-6
    pixels = camera.project(np.where(front[:, None], in_camera, (0.0, 0.0, 1.0)))
    margin = _MARGIN * camera.width
    size = np.array([camera.width, camera.height])
    return np.asarray(front & (pixels > margin).all(axis=1) & (pixels < size - margin).all(axis=1))


def _angle_deg(a: Float64, b: Float64) -> Float64:
    """(N,) between vectors (N, 3) and (N, 3)."""
    sizes = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    return np.degrees(np.arccos(np.clip((a * b).sum(axis=1) / np.maximum(sizes, 1e-300), -1.0, 1.0)))
