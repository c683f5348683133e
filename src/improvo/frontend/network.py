"""The convolutional frontend: an image in, keypoints with descriptors and stability out, in one forward pass."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from improvo.errors import InputError
from improvo.frontend.architecture import CELL
from improvo.frontend.decoding import decode, stability_map
from improvo.frontend.masking import check_image, check_mask
from improvo.frontend.runtime import Runtime, open_runtime
from improvo.frontend.settings import NetworkSettings
from improvo.frontend.weights_files import Weights, find_weights, load_weights
from improvo.types import Features, Float32, Mask

Image = NDArray[Any]  # (H, W) or (H, W, 3) blue-green-red; uint8, or float in [0, 1]


def load_network_frontend(name_or_path: str | Path, **settings: Any) -> NetworkFrontend:
    """A network frontend with bundled weights ("superpoint") or those of a `.safetensors` file.

    Args:
        settings: fields of `NetworkSettings`.

    Raises:
        InputError: no such weights, or a file that cannot be read.
        ConfigError: a setting out of range.
        TypeError: an unknown setting.
    """
    chosen = NetworkSettings(**settings)
    return NetworkFrontend(load_weights(find_weights(name_or_path)), chosen, name=str(name_or_path))


class NetworkFrontend:
    """SuperPoint with a stability head behind the `Frontend` interface.

    Images may have any size and be grey or colour (blue-green-red, as OpenCV reads them), uint8 or float in [0, 1].
    Several threads may call it.
    """

    def __init__(self, weights: Weights, settings: NetworkSettings | None = None, name: str = "") -> None:
        self.name = name or weights.architecture.name
        self.weights = weights
        self.settings = settings or NetworkSettings()
        self._runtime = open_runtime(weights, self.settings)

    @property
    def runtime(self) -> Runtime:
        """What runs the network."""
        return self._runtime

    def __call__(self, image: Image, mask: Mask | None = None) -> Features:
        """Features of one image, best score first; where there is a mask (H, W), on its True pixels.

        Raises:
            InputError: an image of another shape or type, with values that are not finite, or a mask of another size.
        """
        return self.batch([image], None if mask is None else [mask])[0]

    def batch(self, images: Sequence[Image], masks: Sequence[Mask | None] | None = None) -> list[Features]:
        """Features of images of one size, in one pass of the network; memory grows with their number."""
        if not images:
            return []
        for image in images:
            check_image(image)
        sizes = {image.shape[:2] for image in images}
        if len(sizes) > 1:
            raise InputError(f"a batch needs images of one size, these have {sorted(sizes)}; pass them one by one")
        chosen = list(masks) if masks is not None else [None] * len(images)
        for mask in chosen:
            check_mask(mask, images[0].shape)
        prepared = _prepared(images)
        maps = self._runtime(prepared)
        height, width = images[0].shape[:2]
        return [
            decode(maps, row, grey[0, :height, :width], self.settings, mask)
            for row, (grey, mask) in enumerate(zip(prepared, chosen, strict=True))
        ]

    def heat_map(self, image: Image) -> Float32:
        """Probability (H, W) that a pixel is a keypoint, before non-maximum suppression."""
        heat = self._runtime(_prepared([image])).heat[0]
        return heat[: image.shape[0], : image.shape[1]].copy()

    def stability_map(self, image: Image) -> Float32:
        """Probability (H, W) that a keypoint at a pixel is stable (paper, "Stability Classifier Head").

        Raises:
            InputError: the weights have no stability head.
        """
        logits = self._runtime(_prepared([image])).stability_logits
        if logits is None:
            raise InputError(f"{self.name}: these weights have no stability head; use weights that were adapted to VO")
        return stability_map(logits[0], *image.shape[:2])


def _prepared(images: Sequence[Image]) -> Float32:
    """(B, 1, H, W) what the runtime is given."""
    return np.stack([prepare(image) for image in images])[:, None]


def prepare(image: Image) -> Float32:
    """The image as the network reads it: grey, float32 in [0, 1], sides padded to multiples of 8 by repeating the edge.

    Raises:
        InputError: an image of another shape or type, or with values out of range.
    """
    check_image(image)
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] not in (1, 3)) or 0 in image.shape:
        raise InputError(f"image of shape {image.shape}: the network reads (H, W) grey or (H, W, 3) colour")
    if image.dtype == np.uint8:
        scale = 1 / 255
    elif np.issubdtype(image.dtype, np.floating):
        scale = 1.0
        if not (image.min() >= 0 and image.max() <= 1):  # also false where there is a NaN
            raise InputError("image of floats: the network reads values in [0, 1]; divide by 255, and replace NaN")
    else:
        raise InputError(f"image of type {image.dtype}: the network reads uint8, or floats in [0, 1]")
    grey = image
    if image.ndim == 3:
        colour = image.astype(np.float32) if scale == 1 else image
        grey = cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY) if image.shape[2] == 3 else image[:, :, 0]
    height, width = grey.shape
    grey = np.pad(grey, ((0, -height % CELL), (0, -width % CELL)), mode="edge")
    return np.multiply(grey, np.float32(scale), dtype=np.float32)
