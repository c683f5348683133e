"""What runs a network: one interface over OpenVINO (the default, without torch), ONNX Runtime and torch."""

from __future__ import annotations

from typing import Protocol

from improvo.errors import ConfigError, MissingExtraError, installed
from improvo.frontend.channel_pruning import without_dead_channels
from improvo.frontend.decoding import NetworkMaps
from improvo.frontend.settings import NetworkOptions, NetworkSettings
from improvo.frontend.weights_files import Weights
from improvo.jobs.workers import thread_limit
from improvo.types import Float32


class Runtime(Protocol):
    """Runs one network on batches of images."""

    name: str  # library and precision, such as "openvino-float32"

    def __call__(self, images: Float32) -> NetworkMaps:
        """Maps of (B, 1, H, W) images in [0, 1] with sides that are multiples of 8."""
        ...


def cpu_runtime() -> str:
    """`openvino`, or `onnxruntime` where only that is installed."""
    return "onnxruntime" if installed("onnxruntime") and not installed("openvino") else "openvino"


def chosen_runtime(settings: NetworkOptions) -> str:
    """The library that runs a network with these settings: `openvino`, `onnxruntime` or `torch`."""
    if settings.runtime != "auto":
        return settings.runtime
    return "torch" if settings.device == "cuda" or settings.precision == "float16" else cpu_runtime()


def open_runtime(weights: Weights, settings: NetworkSettings) -> Runtime:
    """The runtime that the settings ask for.

    Raises:
        ConfigError: a precision that the runtime or the weights do not have.
        MissingExtraError: the runtime's library is not installed.
    """
    weights = without_dead_channels(weights)
    name = chosen_runtime(settings)
    if name == "torch":
        from improvo.frontend.runtime_torch import TorchRuntime

        if settings.precision == "int8":
            raise ConfigError("setting `precision`: int8 runs in runtime=openvino or onnxruntime, not in torch")
        half = settings.precision == "float16" or (settings.precision == "auto" and settings.device == "cuda")
        return TorchRuntime(weights, device=settings.device, half=half, threads=settings.threads)
    if settings.precision == "float16":
        raise ConfigError(f"setting `precision`: float16 runs in runtime=torch, not in {name}")
    calibrated = bool(weights.card.activation_ranges)
    if settings.precision == "int8" and not calibrated:
        raise ConfigError(
            "setting `precision`: int8 needs weights with activation ranges; `improvo weights calibrate` adds them"
        )
    int8 = calibrated and settings.precision != "float32"
    threads = settings.threads or thread_limit()
    if name == "onnxruntime":
        from improvo.frontend.runtime_onnxruntime import OnnxRuntime

        return OnnxRuntime(weights, int8=int8, threads=threads)
    if not installed("openvino"):
        raise MissingExtraError("running a network without OpenVINO", "onnxruntime")
    from improvo.frontend.runtime_openvino import OpenVinoRuntime

    return OpenVinoRuntime(weights, int8=int8, threads=threads)
