"""Settings of the frontends, importable without the libraries that run them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from improvo.errors import ConfigError

DEFAULT_FRONTEND = "superpoint-vo"
_CHOICES = {
    "runtime": ("auto", "openvino", "onnxruntime", "torch"),
    "precision": ("auto", "float32", "int8", "float16"),
    "device": ("cpu", "cuda"),
}


@dataclass(frozen=True)
class NetworkOptions:
    """How a network turns an image into `Features`, without the number of keypoints.

    Raises:
        ConfigError: a value out of range.
    """

    threshold: float = 0.0005  # least probability of a keypoint
    nms_radius: int = 4  # pixels: a keypoint is the best of the square of this radius around it
    border: int = 4  # pixels: no keypoints this close to the image's edge
    subpixel_radius: int = 4  # move to the centre of mass of the heat map within this radius; 0 keeps whole pixels
    corner_radius: int = 5  # then move to the best corner within this radius, or drop; 0 skips this step
    # auto: openvino on the CPU, onnxruntime where that is not installed; torch where device is cuda
    runtime: Literal["auto", "openvino", "onnxruntime", "torch"] = "auto"
    precision: Literal["auto", "float32", "int8", "float16"] = "auto"  # auto: int8 if the weights are calibrated for it
    threads: int = 0  # 0: one in a worker process, otherwise as many as the machine has or OMP_NUM_THREADS says
    device: Literal["cpu", "cuda"] = "cpu"  # cuda needs torch

    def __post_init__(self) -> None:
        for name in ("nms_radius", "border", "subpixel_radius", "corner_radius"):
            if getattr(self, name) < 0:
                raise ConfigError(f"setting `{name}`: must be at least 0, not {getattr(self, name)}")
        if not 0 <= self.threshold < 1:
            raise ConfigError(f"setting `threshold`: is a probability in [0, 1), not {self.threshold}")
        if self.threads < 0:
            raise ConfigError(f"setting `threads`: must be at least 0 (all), not {self.threads}")
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                raise ConfigError(f"setting `{name}`: choose among {', '.join(choices)}, not {getattr(self, name)!r}")
        if self.device == "cuda" and self.runtime in ("openvino", "onnxruntime"):
            raise ConfigError(f"setting `runtime`: {self.runtime} runs on the CPU; use runtime=torch with device=cuda")


@dataclass(frozen=True)
class NetworkSettings(NetworkOptions):
    """Everything that a `NetworkFrontend` depends on beside its weights."""

    max_keypoints: int = 1000  # kept per image, best first

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.max_keypoints < 1:
            raise ConfigError(f"setting `max_keypoints`: must be at least 1, not {self.max_keypoints}")


@dataclass(frozen=True)
class FrontendSettings:
    """Which frontend, how many keypoints, and how the odometry uses their stability."""

    name: str = DEFAULT_FRONTEND  # sift, orb, akaze, surf, a bundled network, or a .safetensors file
    max_keypoints: int = 1000  # kept per frame, best first
    use_stability: bool = True  # weigh observations with the frontend's stability, where it has one
    least_stability: float = 0.0  # drop keypoints of lower stability; 0 keeps all
    network: NetworkOptions = field(default_factory=NetworkOptions)  # for networks only

    def __post_init__(self) -> None:
        if not 0 <= self.least_stability <= 1:
            raise ConfigError(f"least_stability={self.least_stability}: is a probability between 0 and 1")
        if self.max_keypoints < 50:
            raise ConfigError(f"max_keypoints={self.max_keypoints}: odometry needs at least 50; 1000 is a good start")
