"""Settings of the network frontend, importable without the libraries that run it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from improvo.errors import ConfigError


@dataclass(frozen=True)
class NetworkSettings:
    """How a network turns an image into `Features`.

    Raises:
        ConfigError: a value out of range.
    """

    max_keypoints: int = 1000  # kept per image, best first
    threshold: float = 0.0005  # least probability of a keypoint
    nms_radius: int = 4  # pixels: a keypoint is the best of the square of this radius around it
    border: int = 4  # pixels: no keypoints this close to the image's edge
    subpixel_radius: int = 4  # move to the centre of mass of the heat map within this radius; 0 leaves whole pixels
    corner_radius: int = 5  # then move to the best corner this near, drop what has none; 0 leaves the network's word
    runtime: Literal["auto", "openvino", "torch"] = "auto"  # auto: openvino on the CPU, torch where device is cuda
    precision: Literal["auto", "float32", "int8", "float16"] = "auto"  # auto: int8 if the weights are calibrated for it
    threads: int = 0  # 0: as many as the machine has
    device: Literal["cpu", "cuda"] = "cpu"  # cuda needs torch

    def __post_init__(self) -> None:
        for name, least in (
            ("max_keypoints", 1),
            ("nms_radius", 0),
            ("border", 0),
            ("subpixel_radius", 0),
            ("corner_radius", 0),
        ):
            if getattr(self, name) < least:
                raise ConfigError(f"setting `{name}`: must be at least {least}, not {getattr(self, name)}")
        if not 0 <= self.threshold < 1:
            raise ConfigError(f"setting `threshold`: is a probability in [0, 1), not {self.threshold}")
        if self.threads < 0:
            raise ConfigError(f"setting `threads`: must be at least 0 (all), not {self.threads}")
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                raise ConfigError(f"setting `{name}`: choose among {', '.join(choices)}, not {getattr(self, name)!r}")
        if self.device == "cuda" and self.runtime == "openvino":
            raise ConfigError("setting `runtime`: openvino runs on the CPU; use runtime=torch with device=cuda")


_CHOICES = {
    "runtime": ("auto", "openvino", "torch"),
    "precision": ("auto", "float32", "int8", "float16"),
    "device": ("cpu", "cuda"),
}
