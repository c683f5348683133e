"""Distortion models under the names that other tools have for them, and their coefficients in our order."""

from __future__ import annotations

import re
from typing import Any

# normalised name -> ours; "pinhole" says nothing about distortion, "none" that there is none
MODEL_NAMES = {
    "": "pinhole",
    "pinhole": "pinhole",
    "simplepinhole": "pinhole",
    "perspective": "pinhole",
    "linear": "pinhole",
    "rectified": "none",
    "none": "none",
    "nodistortion": "none",
    "undistorted": "none",
    "brown": "brown",
    "brownconrady": "brown",
    "opencv": "brown",
    "opencv5": "brown",
    "plumbbob": "brown",
    "radtan": "brown",
    "radialtangential": "brown",
    "pinholeradtan": "brown",
    "pinholebrownconrady": "brown",
    "simpleradial": "brown",
    "radial": "brown",
    "frame": "brown",
    "rationalpolynomial": "rational",
    "fullopencv": "rational",
    "opencv8": "rational",
    "pinholefull": "rational",
    "pinholeradtan8": "rational",
    "rational": "rational",
    # RealSense; its ROS driver publishes both as plumb_bob
    "inversebrownconrady": "brown",
    "distortioninversebrownconrady": "brown",
    "modifiedbrownconrady": "modified",
    "distortionmodifiedbrownconrady": "modified",
    "distortionbrownconrady": "brown",
    "distortionnone": "none",
    "equidistant": "fisheye",
    "equi": "fisheye",
    "pinholeequi": "fisheye",
    "pinholeequidistant": "fisheye",
    "fisheye": "fisheye",
    "fisheye4": "fisheye",
    "kb4": "fisheye",
    "kannalabrandt": "fisheye",
    "kannalabrandt4": "fisheye",
    "kannalabrandt8": "fisheye",
    "distortionkannalabrandt4": "fisheye",
    "opencvfisheye": "fisheye",
    "simpleradialfisheye": "fisheye",
    "radialfisheye": "fisheye",
    "fov": "fov",
    "atan": "fov",
    "ftheta": "fov",
    "distortionftheta": "fov",
}
KNOWN_MODELS = "brown (radtan, plumb_bob), rational_polynomial, fisheye (equidistant, Kannala-Brandt), fov, none"


def normalised(name: Any) -> str:
    """A name without case and separators: `Distortion_Coefficients` and `distortionCoefficients` are one."""
    return re.sub(r"[^a-z0-9]", "", str(name).lower())


def model_named(name: Any, key: str = "distortion model") -> str:
    """Which model a name stands for: brown, rational, modified, fisheye, fov, none, or pinhole (says nothing).

    Raises:
        ValueError: it is not supported.
    """
    model = MODEL_NAMES.get(normalised("" if name is None else name))
    if model is None:
        raise ValueError(f"{key} {name!r} is not supported; known: {KNOWN_MODELS}. Undistort the images first")
    return model


def usual_length(distortion: tuple[float, ...], model: str) -> tuple[float, ...]:
    """Coefficients in OpenCV's order, in one of the lengths that `Camera` takes.

    Args:
        distortion: k1, k2, p1, p2[, k3[, k4, k5, k6[, s1 ... s4[, tau_x, tau_y]]]]; k1 to k4; or w.
        model: `brown`, `fisheye` or `fov`.

    Raises:
        ValueError: a count that the model does not have, or coefficients that no supported model has.
    """
    if model == "fov":
        if len(distortion) > 1 and any(distortion[1:]):
            raise ValueError(f"the fov model has 1 coefficient, not {len(distortion)}")
        return distortion[:1]
    if model == "fisheye":
        if len(distortion) < 4 or any(distortion[4:]):
            raise ValueError(f"the fisheye model has 4 coefficients k1 ... k4, not {len(distortion)}")
        return distortion[:4]
    if len(distortion) not in (0, 4, 5, 8, 12, 14):
        raise ValueError(
            f"{len(distortion)} distortion coefficients; OpenCV's order k1, k2, p1, p2, k3, ... has 4, 5, 8, 12 or 14"
        )
    if any(distortion[8:]):
        raise ValueError("thin prism or tilt coefficients (beyond k6) are not supported; undistort the images first")
    return distortion[:8]
