"""The device that a training computes on, its precision, and how arrays get there."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from improvo.errors import ConfigError


def choose_device(name: str) -> torch.device:
    """`auto` is CUDA where there is one.

    Raises:
        ConfigError: CUDA asked for where torch sees none.
    """
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise ConfigError(f"setting `optimiser.device`: torch sees no CUDA device for `{name}`; use cpu or auto")
    return torch.device(("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name)


def choose_precision(name: str, device: torch.device) -> torch.dtype:
    """`auto` is bfloat16 on processors that multiply it natively; elsewhere it would be emulated, and slow."""
    if name == "auto":
        capable = (
            torch.cuda.is_bf16_supported() if device.type == "cuda" else torch.ops.mkldnn._is_mkldnn_bf16_supported()
        )
        return torch.bfloat16 if capable else torch.float32
    return {"float32": torch.float32, "bfloat16": torch.bfloat16}[name]


def on_device(values: NDArray[Any], device: torch.device) -> Tensor:
    """A small array as float32, or int64 where it holds whole numbers, without waiting for what the device does."""
    kind = np.int64 if np.issubdtype(values.dtype, np.integer) else np.float32
    return torch.from_numpy(np.ascontiguousarray(values, kind)).to(device, non_blocking=True)
