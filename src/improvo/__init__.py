"""improvo: self-improving visual odometry (DeTone, Malisiewicz, Rabinovich 2018), and what lies beyond it.

The API is as short as the paper::

    sequence = improvo.open_sequence("video.mp4", camera="camera.yaml")
    frontend = improvo.load_frontend("superpoint-vo")
    odometry = improvo.VisualOdometry(frontend, sequence.camera)
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
    "open_sequence": "improvo.sequences",
    "load_frontend": "improvo.frontend.registry",
    "VisualOdometry": "improvo.odometry.visual_odometry",
    "ImprovoError": "improvo.errors",
}

__all__ = ["VisualOdometry", "open_sequence", "load_frontend", "ImprovoError", "__version__"]  # noqa: RUF022 - in order of use

logging.getLogger(__name__).addHandler(logging.NullHandler())


def __getattr__(name: str) -> Any:
    """Import public names when they are first used, so that `import improvo` costs nothing."""
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    raise AttributeError(f"module 'improvo' has no attribute {name!r}")
