"""sivo: self-improving visual odometry (DeTone, Malisiewicz, Rabinovich 2018), and what lies beyond it.

The API is as short as the paper::

    sequence = sivo.open_sequence("video.mp4", camera="camera.yaml")
    frontend = sivo.load_frontend("superpoint-vo")
    odometry = sivo.VisualOdometry(frontend, sequence.camera)
    for frame in sequence:
        odometry.track(frame)
    odometry.map
"""

from __future__ import annotations

import importlib
import logging
from typing import Any

__version__ = "0.1.0"

_PUBLIC = {
    "open_sequence": "sivo.sequences",
    "load_frontend": "sivo.frontend.registry",
    "VisualOdometry": "sivo.odometry.visual_odometry",
    "SivoError": "sivo.errors",
}

__all__ = ["VisualOdometry", "open_sequence", "load_frontend", "SivoError", "__version__"]  # noqa: RUF022 - in order of use

logging.getLogger(__name__).addHandler(logging.NullHandler())


def __getattr__(name: str) -> Any:
    """Import public names when they are first used, so that `import sivo` costs nothing."""
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'sivo' has no attribute {name!r}")
