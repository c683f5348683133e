"""Can two views start a map? Their relative pose, gated by what a rotation and a homography explain as well."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from improvo.geometry.camera import Camera
from improvo.geometry.epipolar import rotation_residuals
from improvo.geometry.ransac import Ransac, RobustHomography, homography, motions_of_homography, relative_pose
from improvo.geometry.triangulation import triangulate_tracks
from improvo.odometry.gates import MIN_PARALLAX_DEG, gate
from improvo.odometry.mapping.two_motions import has_second_motion
from improvo.odometry.settings import OdometrySettings
from improvo.odometry.view import View, common_tracks, matches_of_world, ransac_pairs
from improvo.tracking.matching import match_units
from improvo.types import Float64, Int64

_STRICT = 2.0 / 3.0  # of the tolerance, since two views have nothing else to be right by
_MIN_INLIER_SHARE = 0.3  # essential inliers of the matches
# Homography inliers over essential inliers: with more the scene is one plane, unless twice min_points are off it. And
# points of a second motion over a plane, over those of the first: with more the choice between them is open.
_MOSTLY = 0.75
_MAX_SECOND_MOTION = 0.5  # spread over the picture of another motion, as a share of the first one's
NO_PARALLAX = "too little parallax"
# Why no map starts where two motions explain two views: which one is the camera's, they do not say.
TWO_MOTIONS = "two motions: one of them is not the camera's"
PLANE_OF_TWO = "a plane with two possible motions"


@dataclass(frozen=True)
class InitialPair:
    """The relative pose of two views, and the points that support it."""

    b_from_a: Float64  # (4, 4), baseline of length 1
    rows_a: Int64  # (N,) keypoints of a
    rows_b: Int64  # (N,) keypoints of b
    xyz: Float64  # (N, 3) in camera a
    parallax_deg: Float64  # (N,)


@dataclass(frozen=True)
class InitFailure:
    """Why a map cannot start yet."""

    reason: str
    costly: bool = False  # found after much work, so that the next try should not follow with the very next frame

    @property
    def undecided(self) -> bool:
        """Whether two motions explain the views, so that the one that was taken before may be right."""
        return self.reason in (TWO_MOTIONS, PLANE_OF_TWO)


def initial_pair(
    a: View, b: View, camera: Camera, settings: OdometrySettings, descriptor_distance: float
) -> InitialPair | InitFailure:
    """Relative pose of two views by the five-point algorithm, or by the homography of a plane.

    Where a pure rotation explains the matches, or a homography explains about as many as the essential matrix does,
    the translation would be noise, and all depths with it; that is so, too, where a rotation explains the tracks, and
    only matches that are made afresh say otherwise. Two cases are accepted all the same: enough points off the
    plane, as in front of a wall; and a scene that is one plane, if its homography stands for a single motion.

    Args:
        a: the earlier view.
        b: the later view.
        camera: pinhole, of both.
        settings: of the odometry; `start`, `ransac_gate` and `tolerance` are used.
        descriptor_distance: the matching threshold on unit descriptors.
    """
    least, strict = settings.start.min_points, _STRICT * settings.tolerance
    matches = matches_of_world(a, b, match_units(a.descriptors, b.descriptors, descriptor_distance))
    rows_a, rows_b = matches[ransac_pairs(a, b, matches, settings)].T
    if len(rows_a) < 2 * least:
        return InitFailure("too few matches")
    pixels_a, pixels_b = a.keypoints[rows_a], b.keypoints[rows_b]
    ransac = Ransac(strict, settings.seed, min_iterations=200, max_iterations=5000)
    essential = relative_pose(pixels_a, pixels_b, camera, ransac)
    plane = homography(pixels_a, pixels_b, ransac)
    inliers = essential.inliers
    if inliers.sum() < max(_MIN_INLIER_SHARE * len(rows_a), least):
        return InitFailure("too few matches agree on a motion")
    if np.median(rotation_residuals(camera, pixels_a[inliers], pixels_b[inliers])) < gate(strict):
        return InitFailure(f"{NO_PARALLAX}: a rotation explains the motion")
    if _rotation_explains_tracks(a, b, camera, settings):
        return InitFailure(f"{NO_PARALLAX}: a rotation explains the tracks")
    another = replace(ransac, max_iterations=1000)
    if has_second_motion(essential.pose, camera, pixels_a, pixels_b, another, _MAX_SECOND_MOTION):
        return InitFailure(TWO_MOTIONS)
    ratio = plane.inliers.sum() / max(inliers.sum(), 1)
    off_plane = (inliers & ~plane.inliers).sum()
    if ratio > _MOSTLY and off_plane < 2 * least:
        return _from_plane(a, b, rows_a, rows_b, plane, camera, settings)
    return _with_points(a, b, rows_a[inliers], rows_b[inliers], essential.pose, camera, settings)


def _rotation_explains_tracks(a: View, b: View, camera: Camera, settings: OdometrySettings) -> bool:
    """Whether what was tracked from one view to the other moved as by a rotation.

    A wall of repeated texture, matched one repetition off, looks as if the camera had moved; tracks, from frame to
    frame, seldom make that mistake.
    """
    rows_a, rows_b = common_tracks(a, b)
    world = ~(a.attached[rows_a] | b.attached[rows_b])
    if world.sum() < settings.start.min_points:
        return False
    residuals = rotation_residuals(camera, a.keypoints[rows_a[world]], b.keypoints[rows_b[world]])
    return bool(np.median(residuals) < _STRICT * settings.tolerance)


def _with_points(
    a: View, b: View, rows_a: Int64, rows_b: Int64, b_from_a: Float64, camera: Camera, settings: OdometrySettings
) -> InitialPair | InitFailure:
    """Triangulate the matches; a failure if too few have parallax."""
    count = len(rows_a)
    keypoints = np.stack([a.keypoints[rows_a], b.keypoints[rows_b]], axis=1).reshape(-1, 2)
    poses = np.stack([np.eye(4), b_from_a])
    offsets = np.arange(0, 2 * count + 1, 2)
    result = triangulate_tracks(keypoints, np.tile([0, 1], count), offsets, poses, camera.K)
    worst = result.errors.reshape(-1, 2).max(axis=1)
    parallax_deg = result.parallax_deg
    good = result.in_front & (worst <= gate(_STRICT * settings.tolerance)) & (parallax_deg > 0.25 * MIN_PARALLAX_DEG)
    if (parallax_deg[good] >= MIN_PARALLAX_DEG).sum() < settings.start.min_points:
        return InitFailure(NO_PARALLAX)
    return InitialPair(b_from_a, rows_a[good], rows_b[good], result.points[good], parallax_deg[good])


def _from_plane(
    a: View, b: View, rows_a: Int64, rows_b: Int64, plane: RobustHomography, camera: Camera, settings: OdometrySettings
) -> InitialPair | InitFailure:
    """The motion over a plane that puts most points in front of both cameras, if no other comes near it."""
    rows_a, rows_b = rows_a[plane.inliers], rows_b[plane.inliers]
    motions = motions_of_homography(plane.b_from_a, camera)
    tried = [_with_points(a, b, rows_a, rows_b, b_from_a, camera, settings) for b_from_a in motions]
    pairs = sorted((pair for pair in tried if isinstance(pair, InitialPair)), key=lambda pair: -len(pair.rows_a))
    if not pairs:
        return InitFailure(NO_PARALLAX)
    if len(pairs) > 1 and len(pairs[1].rows_a) > _MOSTLY * len(pairs[0].rows_a):
        return InitFailure(PLANE_OF_TWO)
    return pairs[0]
