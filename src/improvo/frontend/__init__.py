"""Images in, `Features` (keypoints, descriptors, scores) out: classical detectors and the network.

It imports `jobs` and `untrusted`. The interface is the class `Frontend` below; then open `registry.py`, which finds a
frontend by its name and where a new one is added. `classical.py` is the shortest example.
"""

from __future__ import annotations

from typing import Protocol

from improvo.types import Features, Mask, UInt8


class Frontend(Protocol):
    """What the odometry, the labels and the evaluation need of a frontend."""

    name: str  # as given to `load_frontend`; goes into run.json

    def __call__(self, image: UInt8, mask: Mask | None = None) -> Features:
        """Features of one image (H, W) or (H, W, 3) uint8, best score first; deterministic.

        Where there is a mask (H, W), all of them are on its True pixels, chosen among those there.
        """
        ...
