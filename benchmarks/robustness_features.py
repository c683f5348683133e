"""Features of pictures, kept by the picture's content, so that a run of the odometry alone is quick.

Most faults leave most pictures of a clip as they are, so the same features serve many cases. Descriptors are kept as
float16; the first run uses what the later ones read, so that both give the same result.
"""

from __future__ import annotations

import hashlib
import io
import zipfile
from pathlib import Path

import numpy as np

import improvo.frontend
from improvo.files import written_atomically
from improvo.frontend import Frontend
from improvo.frontend.registry import CLASSICAL
from improvo.frontend.weights_files import find_weights
from improvo.types import Features, Mask, UInt8


class FeatureCache:
    """Features of one frontend.

    Args:
        folder: of the cache.
        frontend: computes what is missing.
        name: its name or weights file; the content of that file, and the code of all frontends, are part of the key.
        keep: write what was missing into the cache.
    """

    def __init__(self, folder: Path, frontend: Frontend, name: str, keep: bool = True) -> None:
        digest = hashlib.blake2b(name.encode(), digest_size=8)
        if name not in CLASSICAL:
            digest.update(Path(find_weights(name)).read_bytes())
        for file in sorted(Path(improvo.frontend.__file__).parent.glob("*.py")):
            digest.update(file.read_bytes())
        self._folder = folder / f"{Path(name).stem}-{digest.hexdigest()}"
        self._frontend = frontend
        self._keep = keep
        self.name = frontend.name

    def __call__(self, image: UInt8, mask: Mask | None = None) -> Features:
        """The features of a picture (H, W); with a mask of the odometry's choice, they are not kept."""
        if mask is not None:
            return _read(_packed(self._frontend(image, mask)))
        key = hashlib.blake2b(image.tobytes() + str(image.shape).encode(), digest_size=16).hexdigest()
        path = self._folder / key[:2] / f"{key}.npz"
        try:
            return _read(path.read_bytes())
        except (FileNotFoundError, ValueError, KeyError, zipfile.BadZipFile):
            pass
        content = _packed(self._frontend(image))
        if self._keep:
            path.parent.mkdir(parents=True, exist_ok=True)
            with written_atomically(path) as temporary:
                temporary.write_bytes(content)
        return _read(content)


def _packed(features: Features) -> bytes:
    descriptors = features.descriptors if features.binary else features.descriptors.astype(np.float16)
    arrays = {"keypoints": features.keypoints, "descriptors": descriptors, "scores": features.scores}
    if features.stability is not None:
        arrays["stability"] = features.stability
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def _read(content: bytes) -> Features:
    with np.load(io.BytesIO(content)) as stored:
        descriptors = stored["descriptors"]
        if descriptors.dtype == np.float16:
            descriptors = descriptors.astype(np.float32)
            descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-12)
        stability = stored.get("stability")
        return Features(stored["keypoints"], descriptors, stored["scores"], stability)
