"""Frontends by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from improvo.errors import ConfigError
from improvo.frontend import Frontend

CLASSICAL = ("sift", "orb", "akaze", "surf")
NETWORKS = ("superpoint-vo", "superpoint", "superpoint-small")


def load_frontend(name: str, max_keypoints: int = 1000, **options: Any) -> Frontend:
    """A frontend by its bundled name, or from a weights file.

    Args:
        name: `sift`, `orb`, `akaze`, `surf`, a bundled network, or the path of a `.safetensors` file.
        max_keypoints: keypoints kept per image, best first.
        options: of that frontend, such as `sensitive` of the classical ones.

    Raises:
        ConfigError: an unknown name or option.
        InputError: a weights file that cannot be read.
    """
    try:
        if name == "surf":
            from improvo.frontend.classical import SurfFrontend

            return SurfFrontend(max_keypoints, **options)
        if name in CLASSICAL:
            from improvo.frontend.classical import ClassicalFrontend

            return ClassicalFrontend(name, max_keypoints, **options)
        if name in NETWORKS or Path(name).suffix == ".safetensors":
            from improvo.frontend.network import load_network_frontend

            return load_network_frontend(name, max_keypoints=max_keypoints, **options)
    except TypeError as error:
        raise ConfigError(f"frontend {name!r}: {error}") from None
    known = ", ".join((*NETWORKS, *CLASSICAL))
    raise ConfigError(f"frontend {name!r}: unknown; choose among {known}, or give a .safetensors weights file")


def load_odometry_frontend(name: str, max_keypoints: int = 1000, least_stability: float = 0.0) -> Frontend:
    """As `load_frontend`, with the classical frontends tuned for odometry: weak points too, spread over the image.

    Args:
        least_stability: keypoints of less stability are dropped; 0 keeps all.
    """
    options: dict[str, Any] = {}
    if name in CLASSICAL:
        options["sensitive"] = True
    if name == "orb":
        options["spread"] = True
    frontend = load_frontend(name, max_keypoints, **options)
    if not least_stability:
        return frontend
    from improvo.frontend.stable_only import StableOnly

    return StableOnly(frontend, least_stability)
