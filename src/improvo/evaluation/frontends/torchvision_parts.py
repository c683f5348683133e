"""The three torchvision functions that ALIKED's package imports, for machines where torchvision does not load.

A CPU build of torch rejects the torchvision of package registries, which is built for CUDA. The deformable convolution
(Dai et al. 2017) is then done in plain torch: each tap of the kernel is sampled bilinearly at its own offset, zero
outside the image, and the taps are summed by a matrix product.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any


@contextmanager
def torchvision_or_parts() -> Iterator[None]:
    """Within the block `import torchvision` works: the installed one if it loads, else these parts of it."""
    try:
        import torchvision  # noqa: F401
    except (ImportError, RuntimeError):
        for name in [name for name in sys.modules if name.partition(".")[0] == "torchvision"]:
            del sys.modules[name]
        parts = _parts()
        sys.modules.update(parts)
        try:
            yield
        finally:  # whoever imported them keeps them; later imports of torchvision must fail as they would
            for name in parts:
                del sys.modules[name]
    else:
        yield


def deform_conv2d(
    input: Any,
    offset: Any,
    weight: Any,
    bias: Any = None,
    stride: int = 1,
    padding: int | tuple[int, int] = 0,
    mask: Any = None,
) -> Any:
    """Deformable convolution with one offset group and stride 1, as `torchvision.ops.deform_conv2d`.

    Args:
        input: (B, C, H, W).
        offset: (B, 2 * kh * kw, H', W') in pixels: y, then x, tap by tap.
        weight: (D, C, kh, kw).
        bias: (D,) or None.
        stride: 1.
        padding: zeros above and below, and left and right.
        mask: (B, kh * kw, H', W') or None.

    Returns:
        (B, D, H', W')
    """
    import torch
    from torch.nn import functional

    if stride != 1:
        raise RuntimeError("deform_conv2d without torchvision does stride 1 only")
    padding_y, padding_x = (padding, padding) if isinstance(padding, int) else padding
    batch, channels, height, width = input.shape
    outputs, _, kernel_height, kernel_width = weight.shape
    rows, columns = offset.shape[-2:]
    y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    total = input.new_zeros((batch, outputs, rows * columns))
    for tap in range(kernel_height * kernel_width):
        tap_y, tap_x = divmod(tap, kernel_width)
        at_y = y + tap_y - padding_y + offset[:, 2 * tap]
        at_x = x + tap_x - padding_x + offset[:, 2 * tap + 1]
        grid = torch.stack([(2 * at_x + 1) / width - 1, (2 * at_y + 1) / height - 1], dim=-1)
        sampled = functional.grid_sample(input, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
        if mask is not None:
            sampled = sampled * mask[:, tap : tap + 1]
        total += weight[:, :, tap_y, tap_x] @ sampled.reshape(batch, channels, -1)
    result = total.reshape(batch, outputs, rows, columns)
    return result if bias is None else result + bias[:, None, None]


def _parts() -> dict[str, ModuleType]:
    from torch import nn

    names = ("torchvision", "torchvision.ops", "torchvision.models", "torchvision.models.resnet")
    modules = {name: ModuleType(name) for name in names}
    resnet: Any = modules["torchvision.models.resnet"]
    resnet.conv1x1 = lambda inputs, outputs, stride=1: nn.Conv2d(inputs, outputs, 1, stride, bias=False)
    resnet.conv3x3 = lambda inputs, outputs, stride=1: nn.Conv2d(inputs, outputs, 3, stride, padding=1, bias=False)
    ops: Any = modules["torchvision.ops"]
    ops.deform_conv2d = deform_conv2d
    for name in names[1:]:
        parent, _, child = name.rpartition(".")
        setattr(modules[parent], child, modules[name])
    return modules
