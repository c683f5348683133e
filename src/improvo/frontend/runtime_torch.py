"""The torch runtime: for CUDA, and as the reference for tests of the default runtime."""

from __future__ import annotations

from contextlib import AbstractContextManager

import numpy as np

from improvo.errors import ConfigError, MissingExtraError
from improvo.frontend.decoding import NetworkMaps
from improvo.frontend.weights_files import Weights
from improvo.types import Float32

try:
    import torch
    from torch.nn.utils.fusion import fuse_conv_bn_eval
except ImportError:
    raise MissingExtraError("the torch runtime", "train") from None

from improvo.frontend.superpoint import SuperPoint, heat_map


class TorchRuntime:
    """Runs a network with torch.

    Args:
        weights: of any architecture.
        device: "cpu" or "cuda".
        half: compute in float16 (CUDA).
        threads: on the CPU; 0 leaves torch's number, any other sets it for the whole process.

    Raises:
        ConfigError: CUDA asked for where torch sees none, or float16 on the CPU.
    """

    def __init__(self, weights: Weights, device: str = "cpu", half: bool = False, threads: int = 0) -> None:
        if device == "cuda" and not torch.cuda.is_available():
            raise ConfigError("setting `device`: torch sees no CUDA device; use device=cpu")
        if half and device == "cpu":
            raise ConfigError("setting `precision`: float16 needs device=cuda")
        if threads:
            torch.set_num_threads(threads)
        self.name = f"torch-{device}-{'float16' if half else 'float32'}"
        self._device = torch.device(device)
        self._type = torch.float16 if half else torch.float32
        self._network = _folded(load_network(weights)).to(self._device, self._type, memory_format=torch.channels_last)

    def __call__(self, images: Float32) -> NetworkMaps:
        """Maps of (B, 1, H, W) images in [0, 1] with sides that are multiples of 8."""
        with torch.inference_mode(), _deterministic():
            batch = torch.from_numpy(np.ascontiguousarray(images)).to(self._device, self._type)
            output = self._network(batch.contiguous(memory_format=torch.channels_last))
            heat = heat_map(output.detector_logits.float())
            stability = None if output.stability_logits is None else _by_cell(output.stability_logits)
            return NetworkMaps(heat.cpu().numpy(), _by_cell(output.descriptors), stability)


def load_network(weights: Weights) -> SuperPoint:
    """The network with these weights, batch norm and all, in evaluation mode: where training starts from."""
    network = SuperPoint(weights.architecture)
    # Batch-norm counters are not in the file; everything else is checked when it is read.
    network.load_state_dict({name: torch.from_numpy(values) for name, values in weights.tensors.items()}, strict=False)
    return network.eval()


def _folded(network: SuperPoint) -> SuperPoint:
    if network.architecture.normalisation == "before_relu":
        for block in network.modules():
            if getattr(block, "norm", None) is not None:
                block.convolution, block.norm = fuse_conv_bn_eval(block.convolution, block.norm), None
    return network


def _by_cell(maps: torch.Tensor) -> Float32:
    return maps.permute(0, 2, 3, 1).float().contiguous().cpu().numpy()


def _deterministic() -> AbstractContextManager[None]:
    return torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True)
