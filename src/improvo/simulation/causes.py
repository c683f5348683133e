"""The true cause of instability of every pixel, computed by the renderer."""

from __future__ import annotations

from enum import IntEnum

import cv2
import numpy as np

from improvo.simulation.renderer import SceneRenderer
from improvo.types import Float32, Float64, Int64, UInt8


class Cause(IntEnum):
    """Values of the label images. Where several apply, the first of this order wins: 1, 2, 4, 3, 5, 0."""

    STATIC = 0  # none of the causes below
    MOVING = 1  # an object that moves
    HIGHLIGHT = 2  # structure made by specular light, which moves with the viewer
    SHADOW_EDGE = 3  # the edge of a cast shadow that moves
    DEPTH_DISCONTINUITY = 4  # a jump of depth: the place of t-junctions
    REPEATED_TEXTURE = 5  # a point that looks like its neighbours


_HIGHLIGHT = 12.0  # grey levels that specular light adds
_SHADOW_STEP = 0.1  # step of the share of light that arrives
_SHADOW_CHANGE = 5.0  # grey levels by which a moving light changes the picture
_SHADOW_DELAY = 0.15  # seconds between the two pictures compared for that
_DEPTH_STEP = 0.04  # second difference of inverse depth, relative; 0 on planes


def cause_image(
    renderer: SceneRenderer, time: float, world_from_cam: Float64, image: UInt8, depth: Float32, geom: Int64
) -> UInt8:
    """The `Cause` of every pixel (H, W).

    Args:
        renderer: of the scene.
        time, world_from_cam: of the frame.
        image: (H, W, 3), what the renderer shows, before any sensor effect.
        depth, geom: (H, W), the renderer's.
    """
    matt = renderer.image(time, world_from_cam, specular=False)
    unshadowed = renderer.image(time, world_from_cam, specular=False, shadows=False)
    later = renderer.image(time + _SHADOW_DELAY, world_from_cam, specular=False)
    known = geom >= 0
    moving = known & renderer.moving[geom]
    causes = np.full(geom.shape, Cause.STATIC, np.uint8)
    causes[known & renderer.repeated[geom]] = Cause.REPEATED_TEXTURE
    causes[_shadow_edges(matt, unshadowed, later)] = Cause.SHADOW_EDGE
    causes[_depth_discontinuities(depth)] = Cause.DEPTH_DISCONTINUITY
    causes[_highlights(image, matt)] = Cause.HIGHLIGHT
    causes[moving] = Cause.MOVING
    return causes


def _highlights(image: UInt8, matt: UInt8) -> np.ndarray:
    """Where specular light is bright and contributes more structure than the surface."""
    added = np.clip(image.astype(np.int16) - matt, 0, 255).max(axis=2).astype(np.uint8)
    kernel = np.ones((5, 5), np.uint8)
    of_light = cv2.morphologyEx(added, cv2.MORPH_GRADIENT, kernel)
    of_surface = cv2.morphologyEx(cv2.cvtColor(matt, cv2.COLOR_RGB2GRAY), cv2.MORPH_GRADIENT, kernel)
    return np.asarray((added >= _HIGHLIGHT) & (of_light >= of_surface))


def _shadow_edges(matt: UInt8, unshadowed: UInt8, later: UInt8) -> np.ndarray:
    grey, full, then = (cv2.cvtColor(i, cv2.COLOR_RGB2GRAY).astype(np.float32) for i in (matt, unshadowed, later))
    share = cv2.GaussianBlur((grey + 2) / (full + 2), (3, 3), 0)
    kernel = np.ones((3, 3), np.uint8)
    step = cv2.morphologyEx(share, cv2.MORPH_GRADIENT, kernel) > _SHADOW_STEP
    change = cv2.dilate(np.abs(grey - then), np.ones((5, 5), np.uint8)) > _SHADOW_CHANGE
    return np.asarray(step & change)


def _depth_discontinuities(depth: Float32) -> np.ndarray:
    near = 1 / np.nan_to_num(depth, nan=1e3)
    jump = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        second = np.abs(np.diff(near, n=2, axis=axis)) / np.take(near, range(1, near.shape[axis] - 1), axis)
        inner = (slice(1, -1), slice(None)) if axis == 0 else (slice(None), slice(1, -1))
        jump[inner] |= second > _DEPTH_STEP
    return jump
