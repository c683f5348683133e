"""What the odometry is given, looked at before anything of it changes: pictures and features that cannot be used."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from improvo.errors import InputError
from improvo.geometry.camera import Camera
from improvo.types import Features, Frame


def check_parts(frontend: object, camera: object) -> None:
    """Refuse what an odometry cannot be made of.

    Raises:
        InputError: the camera has distortion, which the odometry would leave out without a word.
        TypeError: a name or file in place of the frontend, or something else in place of the camera.
    """
    if isinstance(frontend, str | Path):
        raise TypeError(f"frontend: is a {type(frontend).__name__}, give `improvo.load_frontend({str(frontend)!r})`")
    if not isinstance(camera, Camera):
        raise TypeError(f"camera: is a {type(camera).__name__}, give an `improvo.Camera`, or that of a sequence")
    if not camera.is_pinhole:
        mend = "undistort the pictures, by `improvo.sequences.rectification.Rectifier`, and give the camera of those"
        raise InputError(f"camera: has distortion, and the odometry reads undistorted pictures; {mend}")


def check_frame(frame: object, camera: Camera, before: float | None) -> None:
    """Refuse a picture that is not what the camera makes.

    Args:
        frame: to be tracked.
        camera: of the odometry.
        before: time of the frame before; None for the first.

    Raises:
        TypeError: it is no frame.
        InputError: it has another size or type, or the time is no number above the one before.
    """
    if not isinstance(frame, Frame):
        mend = 'give `improvo.Frame(number, seconds, image, "my camera")`'
        raise TypeError(f"frame: is a {type(frame).__name__}; {mend}")
    image: Any = frame.image
    wanted = f"this odometry reads uint8 pictures of {camera.width}x{camera.height}, those of its camera"
    if not isinstance(image, np.ndarray):
        raise InputError(f"{frame.source}: the picture is a {type(image).__name__}; {wanted}, as NumPy arrays (H, W)")
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3):
        raise InputError(f"{frame.source}: the picture has the shape {image.shape}; {wanted}, (H, W) or (H, W, 3)")
    if image.dtype != np.uint8:
        mend = "multiply by 255 and convert" if image.dtype.kind == "f" else "scale its values to 0 to 255 and convert"
        raise InputError(f"{frame.source}: the picture is of type {image.dtype}; {wanted}: {mend}")
    if image.shape[:2] != (camera.height, camera.width):
        own = f"{image.shape[1]}x{image.shape[0]}"
        mend = "resize it, or make a new VisualOdometry with `camera.resized(width, height)`"
        raise InputError(f"{frame.source}: the picture has {own} pixels; {wanted}: {mend}")
    check_time(frame.time, before)


def check_time(time: float, before: float | None) -> None:
    """Refuse a time that is not a number of seconds, or not after that of the frame before; None for the first frame.

    Files and trajectories find a frame by its time, so of two with the same one would be lost.

    Raises:
        InputError: it is not.
    """
    try:
        finite = math.isfinite(time)
    except (TypeError, ValueError, OverflowError):
        finite = False
    if not finite:
        raise InputError(f"time {time!r}: a frame needs a finite time in seconds")
    if before is not None and not time > before:
        raise InputError(f"time {time!r}: the frame before was at {before!r}; times of frames increase")


def check_features(features: Features, width: int | None) -> None:
    """Refuse features whose arrays do not belong together.

    Args:
        features: of a frame.
        width: of the descriptors of the frame before; None for the first.

    Raises:
        InputError: shapes that do not fit, other descriptors than before, or places that are no numbers.
    """
    count = len(features.keypoints)
    shapes = f"keypoints {features.keypoints.shape}, descriptors {features.descriptors.shape}"
    per_point = [features.descriptors, features.scores, *([] if features.stability is None else [features.stability])]
    if features.keypoints.shape != (count, 2) or any(len(one) != count for one in per_point):
        raise InputError(f"features: the arrays do not fit ({shapes}); they are (N, 2), (N, D), (N,)")
    if features.descriptors.ndim != 2 or (width is not None and features.descriptors.shape[1] != width):
        raise InputError(f"features: {shapes}, where the frame before had {width} columns; use one frontend throughout")
    if not (np.isfinite(features.keypoints).all() and np.isfinite(features.weights()).all()):
        raise InputError("features: keypoints or stabilities are NaN or infinite; correct the frontend")


class OneThread:
    """Lets in one thread at a time, and tells any other so instead of letting it wait."""

    def __init__(self) -> None:
        self._lock = threading.RLock()

    @contextmanager
    def alone(self) -> Iterator[None]:
        """The block is run by one thread; that thread may enter again.

        Raises:
            RuntimeError: another thread is within.
        """
        if not self._lock.acquire(blocking=False):
            raise RuntimeError("another thread is tracking with this VisualOdometry; make one for each thread")
        try:
            yield
        finally:
            self._lock.release()
