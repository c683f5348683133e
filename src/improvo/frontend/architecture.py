"""The architecture of a network, without torch: the widths, the order of normalisation, and the resulting layers.

The paper fixes the architecture `superpoint` ("Convolutional Frontend"): a backbone of eight 3×3 convolutions,
64-64-64-64-128-128-128-128, with a 2×2 max-pool after the second, fourth and sixth, and three heads of one 3×3
convolution (256) and one 1×1: detector 65, descriptor 256, stability 2.

`superpoint-small` halves every width. Its descriptors are 128-D, which halves the cost of matching and the memory; the
128 channels of its descriptor head would not support more.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

from improvo.errors import ConfigError

CELL = 8  # pixels of a cell's side: three max-pools
DETECTOR_CHANNELS = CELL * CELL + 1  # the pixels of a cell, row by row, then the dustbin ("no keypoint here")
POOL_AFTER = (1, 3, 5)  # encoder layers (0-based) that a 2×2 max-pool follows

Normalisation = Literal["none", "before_relu", "after_relu"]


@dataclass(frozen=True)
class Architecture:
    """The shape of a SuperPoint network; goes into the model card, and is all that is needed to build the network."""

    name: str
    encoder: tuple[int, ...] = (64, 64, 64, 64, 128, 128, 128, 128)  # channels of the 3×3 convolutions
    head: int = 256  # channels of the 3×3 convolution that each head starts with
    descriptor: int = 256  # dimensions of a descriptor
    stability: bool = True  # whether there is a stability head
    # Batch norm on every 3×3 convolution, none on the last 1×1 of a head. Before the ReLU it folds into the
    # convolution exactly; after the ReLU it stays a scale and a shift.
    normalisation: Normalisation = "before_relu"
    norm_epsilon: float = 1e-5

    def __post_init__(self) -> None:
        if len(self.encoder) != 8:
            raise ConfigError(f"architecture {self.name}: encoder has {len(self.encoder)} widths, it takes 8")
        if min(*self.encoder, self.head, self.descriptor) < 1:
            raise ConfigError(f"architecture {self.name}: every width must be positive")
        if self.normalisation not in ("none", "before_relu", "after_relu"):
            raise ConfigError(
                f"architecture {self.name}: normalisation is none, before_relu or after_relu, not {self.normalisation}"
            )

    def without_normalisation(self) -> Architecture:
        """The same network without batch norm: what folding leaves."""
        return replace(self, normalisation="none")

    @property
    def heads(self) -> dict[str, int]:
        """Name of each head and the channels it puts out."""
        heads = {"detector": DETECTOR_CHANNELS, "descriptor": self.descriptor}
        return {**heads, "stability": 2} if self.stability else heads

    def convolutions(self) -> Iterator[Convolution]:
        """All convolutions in the order in which they run; their names are the keys of the weights file."""
        channels = 1  # grey image
        for layer, width in enumerate(self.encoder):
            yield Convolution(f"encoder.{layer}", channels, width, kernel=3)
            channels = width
        for head, outputs in self.heads.items():
            yield Convolution(f"{head}.0", channels, self.head, kernel=3)
            yield Convolution(f"{head}.1", self.head, outputs, kernel=1)

    def multiplications(self, height: int, width: int) -> int:
        """Multiply-accumulates of one forward pass on an image of that size (sides padded to multiples of 8)."""
        total = 0
        height, width = -(-height // CELL) * CELL, -(-width // CELL) * CELL
        for layer in self.convolutions():
            room, _, position = layer.name.partition(".")
            step = 2 ** sum(int(position) > pool for pool in POOL_AFTER) if room == "encoder" else CELL
            total += (height // step) * (width // step) * layer.inputs * layer.outputs * layer.kernel**2
        return total


@dataclass(frozen=True)
class Convolution:
    """One convolution, stride 1, zero-padded to keep the size; a 3×3 one has a ReLU behind it, a 1×1 one has not."""

    name: str
    inputs: int
    outputs: int
    kernel: int


ARCHITECTURES = {
    "superpoint": Architecture("superpoint"),
    "superpoint-small": Architecture(
        "superpoint-small", encoder=(32, 32, 32, 32, 64, 64, 64, 64), head=128, descriptor=128
    ),
}
