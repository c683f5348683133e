"""Converts public SuperPoint weights: three layouts, recognised by the names of their tensors.

They differ in where batch norm sits: nowhere (the original release), before the ReLU, or after it. None has a
stability head.
"""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from improvo.errors import ConfigError, InputError, MissingExtraError, imported
from improvo.frontend.architecture import Architecture, Normalisation
from improvo.frontend.weights_files import ModelCard, Weights
from improvo.types import Float32, Float64
from improvo.untrusted.arrays import check_array
from improvo.untrusted.limits import MAX_WEIGHTS_BYTES
from improvo.untrusted.text import reason

Tensors = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class Layout:
    """How one public implementation names its layers."""

    name: str
    normalisation: Normalisation
    norm_epsilon: float
    names: dict[str, tuple[str, str]]  # our layer -> their convolution and batch norm

    def prefixes(self, tensors: Tensors) -> list[str]:
        """What stands before this layout's names, such as `module.` or `superpoint.`, wherever all of them are."""
        first = f"{next(iter(self.names.values()))[0]}.weight"
        found = [name.removesuffix(first) for name in tensors if name == first or name.endswith(f".{first}")]
        return [prefix for prefix in found if self.fits(tensors, prefix)]

    def fits(self, tensors: Tensors, prefix: str = "") -> bool:
        """Whether all of its convolutions are there."""
        return all(f"{prefix}{convolution}.weight" in tensors for convolution, _ in self.names.values())


def _plain(norms: bool) -> dict[str, tuple[str, str]]:
    """`convPa` and `bnPa`, `convPb`, ... of the heads; `conv1a` to `conv4b` of the encoder."""
    encoder = [f"{stage}{half}" for stage in "1234" for half in "ab"]
    ours = {f"encoder.{position}": name for position, name in enumerate(encoder)}
    ours |= {"detector.0": "Pa", "detector.1": "Pb", "descriptor.0": "Da", "descriptor.1": "Db"}
    return {layer: (f"conv{name}", f"bn{name}" if norms else "") for layer, name in ours.items()}


def _stages() -> dict[str, tuple[str, str]]:
    """`inc` and `down1` to `down3`, each a sequence: convolution, norm, ReLU, convolution, norm, ReLU."""
    stages = ["inc.conv", *(f"down{stage}.mpconv.1" for stage in (1, 2, 3))]
    encoder = [(f"{stage}.conv.{first}", f"{stage}.conv.{first + 1}") for stage in stages for first in (0, 3)]
    return {f"encoder.{position}": names for position, names in enumerate(encoder)}


def _blocks() -> dict[str, tuple[str, str]]:
    """`backbone.STAGE.HALF`, `detector.N`, `descriptor.N`, each with `conv` and `bn`."""
    ours = {f"encoder.{2 * stage + half}": f"backbone.{stage}.{half}" for stage in range(4) for half in (0, 1)}
    ours |= {f"{head}.{part}": f"{head}.{part}" for head in ("detector", "descriptor") for part in (0, 1)}
    return {layer: (f"{name}.conv", f"{name}.bn") for layer, name in ours.items()}


LAYOUTS = (
    Layout("no batch norm (original release)", "none", 0.0, _plain(norms=False)),
    Layout("batch norm before ReLU", "before_relu", 1e-5, {**_plain(norms=True), **_stages()}),
    Layout("batch norm after ReLU", "after_relu", 1e-3, _blocks()),
)


def read_public_file(path: Path) -> dict[str, NDArray[Any]]:
    """Tensors of a `.safetensors` or torch file; nothing but tensors is unpickled.

    Raises:
        InputError: missing, unreadable, or holding more than tensors.
        MissingExtraError: a torch file without torch installed.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the weights file of a public SuperPoint")
    try:
        if path.suffix == ".safetensors":
            from safetensors.numpy import load_file

            check_array("tensors", (path.stat().st_size,), 1, MAX_WEIGHTS_BYTES)
            return dict(load_file(path))
        torch = imported("torch", "reading a torch file", "train")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of pickle protocols, when the file is no torch file at all
            _check_torch_file(path)
            checkpoint = torch.load(path, map_location="cpu", weights_only=True)
            return _tensors(path, checkpoint, torch)
    except (MissingExtraError, InputError):
        raise
    except Exception as error:  # torch and safetensors raise many kinds, from RuntimeError to UnpicklingError
        told = reason(error)
        if type(error).__name__ == "UnpicklingError":  # torch advises to load it without refusing anything
            told = "no torch file, or one with more than tensors"
        mend = "save its state_dict alone"
        raise InputError(f"{path}: not readable as a file of tensors ({told}); {mend}") from None


def _check_torch_file(path: Path) -> None:
    """Refuse a torch file that unpacks to more than it weighs, or is too large.

    Raises:
        ValueError: it is.
    """
    check_array("tensors", (path.stat().st_size,), 1, MAX_WEIGHTS_BYTES)
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            check_array("tensors", (sum(info.file_size for info in archive.infolist()),), 1, MAX_WEIGHTS_BYTES)


def _tensors(path: Path, checkpoint: Any, torch: Any) -> dict[str, NDArray[Any]]:
    """The tensors of a state_dict as float32; those that say they are larger than what is stored are refused.

    Raises:
        ValueError: they are.
    """
    found: dict[str, NDArray[Any]] = {}
    total = 0
    for name, values in _state_dict(path, checkpoint).items():
        if not isinstance(values, torch.Tensor) or not isinstance(name, str):
            continue
        if values.layout != torch.strided or values.is_quantized or values.is_complex():
            raise ValueError(f"`{name}` is no plain tensor")
        size = check_array(name, values.shape, values.element_size(), MAX_WEIGHTS_BYTES)
        if size > values.untyped_storage().nbytes():
            raise ValueError(f"`{name}` says that it has {size} bytes, and has {values.untyped_storage().nbytes()}")
        total += check_array(name, values.shape, 4, MAX_WEIGHTS_BYTES - total)
        found[name.removeprefix("module.")] = values.float().numpy()
    return found


def _state_dict(path: Path, checkpoint: Any) -> dict[str, Any]:
    for key in ("model_state_dict", "state_dict", "model"):
        if isinstance(checkpoint, dict) and isinstance(checkpoint.get(key), dict):
            checkpoint = checkpoint[key]
    if not isinstance(checkpoint, dict):
        raise InputError(f"{path}: holds a {type(checkpoint).__name__}, not a state_dict; save its state_dict alone")
    return checkpoint


def convert(tensors: Tensors, source: str, licence: str) -> tuple[Weights, Layout]:
    """Public tensors as ours. The batch norm behind a last 1×1 convolution is folded into it, the others are kept.

    Args:
        tensors: as `read_public_file` gives them.
        source: where they come from, for messages and the model card.
        licence: goes into the model card.

    Raises:
        InputError: none of the three layouts, tensors missing from it, or a batch norm that it does not have.
    """
    fitting = next(((layout, found) for layout in reversed(LAYOUTS) if (found := layout.prefixes(tensors))), None)
    if fitting is None:
        known = "; ".join(layout.name for layout in LAYOUTS)
        raise InputError(f"{source}: not a SuperPoint layout that is known here ({known}); export it in one of these")
    layout, prefixes = fitting
    if len(prefixes) > 1:
        named = ", ".join(f"`{prefix}`" for prefix in prefixes)
        raise InputError(f"{source}: holds {len(prefixes)} networks, under {named}; save the one that you mean alone")
    tensors = {
        name.removeprefix(prefixes[0]): values for name, values in tensors.items() if name.startswith(prefixes[0])
    }
    known_norms = {f"{norm}.running_mean" for _, norm in layout.names.values() if layout.normalisation != "none"}
    unknown = sorted({name for name in tensors if name.endswith("running_mean")} - known_norms)
    if unknown:
        raise InputError(
            f"{source}: {layout.name}, but it has `{unknown[0]}`; fold its batch norm into the convolutions, or save "
            "the network of that layout alone"
        )
    try:
        ours: dict[str, Float32] = {}
        for layer, (convolution, norm) in layout.names.items():
            ours.update(_layer(tensors, layer, convolution, norm, layout))
        architecture = _architecture(ours, layout)
        return Weights(ModelCard(architecture, licence, notes=f"converted from {source} ({layout.name})"), ours), layout
    except KeyError as error:
        raise InputError(f"{source}: {layout.name}: tensor {error.args[0]} is missing; the file is not whole") from None
    except (ValueError, ConfigError) as error:
        raise InputError(f"{source}: {layout.name}: shapes that do not fit together ({error})") from None


def _layer(tensors: Tensors, layer: str, convolution: str, norm: str, layout: Layout) -> dict[str, Float32]:
    weight: Float64 = tensors[f"{convolution}.weight"].astype(np.float64)
    bias: Float64 = tensors[f"{convolution}.bias"].astype(np.float64)
    kept: dict[str, Any] = {}
    if layout.normalisation != "none":
        parts = {part: tensors[f"{norm}.{part}"] for part in ("weight", "bias", "running_mean", "running_var")}
        if layer.endswith(".1") and not layer.startswith("encoder"):  # no ReLU there: the norm is part of the layer
            scale = parts["weight"] / np.sqrt(parts["running_var"].astype(np.float64) + layout.norm_epsilon)
            weight = weight * scale[:, None, None, None]
            bias = (bias - parts["running_mean"]) * scale + parts["bias"]
        else:
            kept = {f"{layer}.norm.{part}": values for part, values in parts.items()}
    kept |= {f"{layer}.convolution.weight": weight, f"{layer}.convolution.bias": bias}
    return {name: np.asarray(values, np.float32) for name, values in kept.items()}


def _architecture(tensors: dict[str, Float32], layout: Layout) -> Architecture:
    def width(layer: str) -> int:
        return len(tensors[f"{layer}.convolution.weight"])

    return Architecture(
        "superpoint",
        encoder=tuple(width(f"encoder.{position}") for position in range(8)),
        head=width("detector.0"),
        descriptor=width("descriptor.1"),
        stability=False,
        normalisation=layout.normalisation,
        norm_epsilon=layout.norm_epsilon or Architecture.norm_epsilon,
    )
