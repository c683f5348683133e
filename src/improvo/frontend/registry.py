"""Frontends by name. A new one is a class like the protocol `Frontend`, and a branch of `load_frontend`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from improvo.errors import ConfigError
from improvo.frontend import Frontend
from improvo.frontend.settings import DEFAULT_FRONTEND, FrontendSettings, NetworkOptions

CLASSICAL = ("sift", "orb", "akaze", "surf")
NETWORKS = ("superpoint-vo", "superpoint", "superpoint-vo-small", "superpoint-small")


def load_frontend(
    name: str | Path = DEFAULT_FRONTEND,
    max_keypoints: int = 1000,
    *,
    least_stability: float = 0.0,
    network: NetworkOptions | None = None,
    opencv_defaults: bool = False,
) -> Frontend:
    """A frontend by its bundled name, or from a weights file, as `improvo run` uses it.

    The classical ones are tuned for odometry: they detect weakly textured points too, and ORB spreads its points over
    the image.

    Args:
        name: `sift`, `orb`, `akaze`, `surf`, a bundled network, or the path of a `.safetensors` file.
        max_keypoints: keypoints kept per image, best first.
        least_stability: keypoints that the stability head gives a lower probability are dropped; 0 keeps all.
        network: threshold, device, precision and the rest of a network.
        opencv_defaults: the classical frontends as OpenCV has them, which the paper compares with.

    Raises:
        ConfigError: an unknown name, no keypoints, network options for a classical frontend, or `least_stability` for
            a frontend without a stability head.
        MissingExtraError: `surf` without the package mahotas.
        InputError: a weights file that cannot be read.
    """
    name = str(name)
    check_frontend(name, network)
    if max_keypoints < 1:
        raise ConfigError(f"setting `max_keypoints`: must be at least 1, not {max_keypoints}")
    if name == "surf":
        from improvo.frontend.classical import SurfFrontend

        frontend: Frontend = SurfFrontend(max_keypoints, sensitive=not opencv_defaults)
    elif name in CLASSICAL:
        from improvo.frontend.classical import ClassicalFrontend

        spread = name == "orb" and not opencv_defaults
        frontend = ClassicalFrontend(name, max_keypoints, sensitive=not opencv_defaults, spread=spread)
    else:
        from improvo.frontend.network import load_network_frontend

        frontend = load_network_frontend(name, max_keypoints=max_keypoints, **asdict(network or NetworkOptions()))
    if not least_stability:
        return frontend
    from improvo.frontend.stable_only import StableOnly, no_stability_head

    if name in CLASSICAL or not frontend.weights.architecture.stability:  # type: ignore[attr-defined]
        raise no_stability_head(name)

    return StableOnly(frontend, least_stability)


def check_frontend(name: str, network: NetworkOptions | None = None) -> None:
    """Refuse a wrong name before any work is done; nothing is loaded. Arguments as `load_frontend`.

    Raises:
        ConfigError: an unknown name, or network options for a classical frontend.
        InputError: a weights file that is not there.
        MissingExtraError: `surf` without the package mahotas.
    """
    if name in CLASSICAL:
        if name == "surf":
            from improvo.frontend.classical import SurfFrontend

            SurfFrontend()  # whether what it needs is installed
        if network not in (None, NetworkOptions()):
            raise ConfigError(
                f"frontend {name}: is not a network, so the settings `frontend.network` do not apply to it"
            )
        return
    if name not in NETWORKS and Path(name).suffix != ".safetensors":
        known = ", ".join((*NETWORKS, *CLASSICAL))
        raise ConfigError(f"frontend {name!r}: unknown; choose among {known}, or give a .safetensors weights file")
    from improvo.frontend.weights_files import find_weights

    find_weights(name)


def frontend_from(settings: FrontendSettings) -> Frontend:
    """The frontend that the settings of a run name. Raises as `load_frontend`."""
    return load_frontend(
        settings.name,
        settings.max_keypoints,
        least_stability=settings.least_stability,
        network=settings.network,
    )
