"""Compiling the kernels of dense depth ahead of time, so that the first frame does not look stuck."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from improvo.depth import agreement_kernels, refine_kernels, sweep_kernels
from improvo.depth.agreement import agreed_depth
from improvo.depth.depth_map import DepthMap
from improvo.depth.plane_sweep import sweep_prepared
from improvo.depth.prepared_image import prepare_image
from improvo.depth.refine import refine_depth
from improvo.depth.settings import AgreementSettings, RefineSettings, SweepSettings


def kernels_are_cached() -> bool:
    """Whether compiled copies are on disk; they may still be stale, which only costs a compilation."""
    kernels = (sweep_kernels.sweep, sweep_kernels.pick, refine_kernels.measure, agreement_kernels.compare)
    folders = [kernel.stats.cache_path for kernel in kernels]  # None where nothing can be cached
    return all(
        folder is not None and any(Path(folder).glob(f"*{kernel.__name__}-*.nbi"))
        for kernel, folder in zip(kernels, folders, strict=True)
    )


def compile_depth(progress: Callable[[str], None] | None = None) -> None:
    """Run every kernel once on a tiny picture; `progress` is told before it takes seconds, once per installation."""
    if progress is not None and not kernels_are_cached():
        progress("compiling the plane sweep (once, about 10 s)")
    image = prepare_image(np.arange(32 * 32, dtype=np.uint8).reshape(32, 32))
    poses = np.stack([np.eye(4), np.eye(4)])
    poses[:, 0, 3] = 0.1, -0.1
    K = np.array([[16.0, 0, 8], [0, 16, 8], [0, 0, 1]])
    found = sweep_prepared(image, [image, image], poses, K, (0.5, 4.0), SweepSettings(planes=8))
    known = DepthMap(np.ones_like(found.depth), np.ones_like(found.depth), K)
    refine_depth(known, image, [image, image], poses, RefineSettings(steps=1))
    agreed_depth(known, [known, known], poses, AgreementSettings())
