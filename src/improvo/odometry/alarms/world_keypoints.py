"""More keypoints of the world where something attached to the camera takes a large part of a frontend's best ones.

A logo has sharp corners, so a frontend that keeps its strongest keypoints may keep few others. Where the odometry knows
the attached part of the picture and it holds many of the keypoints, the frontend is asked a second time, for the rest
of the picture. Keypoints of the attached part stay as they were: raw tracks need them, and so does the evidence.
"""

from __future__ import annotations

from dataclasses import replace
from inspect import signature

import numpy as np

from improvo.frontend import Frontend
from improvo.frontend.masking import features_of, unmasked
from improvo.types import Features, Frame, Mask

AHEAD = 2  # frames detected before their turn (`odometry/run/look_ahead.py`); more cost memory and save no time


class WorldKeypoints:
    """Features of frames, given what is known of the camera's attachments.

    What is known counts `AHEAD` + 1 frames later, so that detecting ahead in a thread gives the same features as
    detecting frame after frame.

    Args:
        frontend: is asked.
    """

    def __init__(self, frontend: Frontend) -> None:
        self._frontend = frontend
        self._world: dict[int, Mask] = {}  # by the frame after which it was known; written by one thread, read by one
        self._detected = 0  # frames

    def know(self, frame_index: int, attached: Mask | None) -> None:
        """After a frame was processed.

        Args:
            frame_index: its number.
            attached: (H, W) pixels that show something attached to the camera, or may; None: no second detection.
        """
        self._world.pop(frame_index - 3 * (AHEAD + 1), None)
        if attached is not None:
            self._world[frame_index] = ~attached

    def __call__(self, frame: Frame) -> Features:
        """Features of the next frame, strongest first."""
        world = self._world.get(self._detected - AHEAD - 1)
        self._detected += 1
        features = features_of(self._frontend, frame)
        if world is None or "mask" not in signature(self._frontend).parameters:  # one that a user wrote need not
            return features
        used = world if frame.mask is None else world & frame.mask
        more = features_of(self._frontend, replace(frame, mask=used))
        return _strongest_first(features.take(~unmasked(features.keypoints, used)), more)


def _strongest_first(a: Features, b: Features) -> Features:
    """The features of both."""
    both = Features(
        np.concatenate([a.keypoints, b.keypoints]),
        np.concatenate([a.descriptors, b.descriptors]),
        np.concatenate([a.scores, b.scores]),
        None if a.stability is None or b.stability is None else np.concatenate([a.stability, b.stability]),
    )
    return both.best(len(both))
