"""Weights files: safetensors with the model card in the header, and the card again as JSON beside it for readers."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from improvo import config, files
from improvo.errors import ConfigError, InputError
from improvo.formats import FORMAT, FORMAT_KEY, check_format
from improvo.frontend.architecture import Architecture, Convolution
from improvo.types import Float32
from improvo.untrusted.arrays import check_array
from improvo.untrusted.limits import MAX_WEIGHTS_BYTES
from improvo.untrusted.paths import check_readable
from improvo.untrusted.text import load_json, reason

BUNDLED = Path(__file__).parent / "weights"
HEADER_KEY = "improvo_model_card"


@dataclass(frozen=True)
class DataSource:
    """Pictures that weights were trained on."""

    name: str
    licence: str
    attribution: str = ""


@dataclass(frozen=True)
class ModelCard:
    """What a weights file says about itself."""

    architecture: Architecture
    licence: str  # of the weights
    data: tuple[DataSource, ...] = ()
    training: dict[str, Any] = field(default_factory=dict)  # stage, steps, seed, settings, parent weights
    metrics: dict[str, Any] = field(default_factory=dict)
    commit: str = ""  # of the code that trained them
    notes: str = ""
    # Largest input of each convolution over calibration pictures, for the int8 runtime; empty if not calibrated.
    activation_ranges: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Weights:
    """A weights file in memory."""

    card: ModelCard
    tensors: dict[str, Float32] = field(repr=False)  # keys, shapes: `SuperPoint(card.architecture).state_dict()`

    @property
    def architecture(self) -> Architecture:
        """The network that the tensors belong to."""
        return self.card.architecture

    def folded(self) -> list[FoldedLayer]:
        """The layers as inference runs them: batch norm folded into the convolution, or left as scale and shift."""
        return [self._fold(layer) for layer in self.architecture.convolutions()]

    def _fold(self, layer: Convolution) -> FoldedLayer:
        weight = self.tensors[f"{layer.name}.convolution.weight"].astype(np.float64)
        bias = self.tensors[f"{layer.name}.convolution.bias"].astype(np.float64)
        scale = shift = None
        if layer.kernel > 1 and self.architecture.normalisation != "none":
            gamma, beta, mean, variance = (
                self.tensors[f"{layer.name}.norm.{part}"].astype(np.float64) for part in _NORM_PARTS
            )
            scale = gamma / np.sqrt(variance + self.architecture.norm_epsilon)
            shift = beta - mean * scale
            if self.architecture.normalisation == "before_relu":
                weight, bias = weight * scale[:, None, None, None], bias * scale + shift
                scale = shift = None
        single = [None if values is None else values.astype(np.float32) for values in (scale, shift)]
        return FoldedLayer(layer, weight.astype(np.float32), bias.astype(np.float32), *single)


@dataclass(frozen=True)
class FoldedLayer:
    """Numbers of one convolution at inference: x -> relu(weight * x + bias) · scale + shift; 1×1: weight * x + bias."""

    convolution: Convolution
    weight: Float32  # (outputs, inputs, kernel, kernel)
    bias: Float32  # (outputs,)
    scale: Float32 | None = None  # (outputs,)
    shift: Float32 | None = None  # (outputs,)


_NORM_PARTS = ("weight", "bias", "running_mean", "running_var")


def expected_shapes(architecture: Architecture) -> dict[str, tuple[int, ...]]:
    """Name and shape of every tensor that a weights file of this architecture holds."""
    shapes: dict[str, tuple[int, ...]] = {}
    for layer in architecture.convolutions():
        shapes[f"{layer.name}.convolution.weight"] = (layer.outputs, layer.inputs, layer.kernel, layer.kernel)
        shapes[f"{layer.name}.convolution.bias"] = (layer.outputs,)
        if layer.kernel > 1 and architecture.normalisation != "none":
            shapes.update({f"{layer.name}.norm.{part}": (layer.outputs,) for part in _NORM_PARTS})
    return shapes


def save_weights(path: Path, tensors: Mapping[str, NDArray[np.generic]], card: ModelCard) -> None:
    """Write `path` (.safetensors) with the card inside, and the card again as JSON with the same stem.

    Args:
        tensors: the network's `state_dict()` as arrays; batch-norm counters are left out. Same tensors and card, same
            bytes.

    Raises:
        InputError: the tensors do not belong to the card's architecture, or are not all finite.
        OutputError: the file cannot be written.
    """
    from safetensors.numpy import save

    kept = {name: np.ascontiguousarray(values, np.float32) for name, values in tensors.items() if not _counter(name)}
    _check_tensors(path, kept, card.architecture)
    # the format stands within the card: safetensors writes several entries of its metadata in any order
    text = json.dumps({FORMAT_KEY: FORMAT, **config.to_dict(card)}, allow_nan=False)
    with files.written_atomically(path) as temporary:
        temporary.write_bytes(save(dict(sorted(kept.items())), metadata={HEADER_KEY: text}))
    files.write_json(path.with_suffix(".json"), config.to_dict(card))


def load_weights(path: Path) -> Weights:
    """Read a weights file; nothing is unpickled or executed.

    Raises:
        InputError: missing, truncated, not safetensors, without an improvo card, of another architecture, or written
            by a later improvo.
    """
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise InputError(f"{path}: no such weights file; bundled: {', '.join(bundled_names()) or 'none'}")
    check_readable(path)
    try:
        check_array("tensors", (path.stat().st_size,), 1, MAX_WEIGHTS_BYTES)
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            header = metadata.get(HEADER_KEY) or metadata.get(f"{files.FORMER_NAME}_model_card")
            tensors = {name: np.asarray(file.get_tensor(name), np.float32) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError, TypeError, MemoryError, AttributeError) as error:
        words = f"not a safetensors file, or truncated ({reason(error)})"
        raise InputError(f"{path}: {words}; fetch or export it again") from None
    if header is None:
        raise InputError(f"{path}: safetensors without an improvo model card; convert it with `improvo weights import`")
    try:
        values = load_json(header)
        if isinstance(values, dict):
            check_format(values.pop(FORMAT_KEY, None), path, "fetch or export it again")
        card = config.from_dict(ModelCard, values, where="model card")
    except (ValueError, ConfigError) as error:
        raise InputError(f"{path}: not readable, {error}; was it made by another version of improvo?") from None
    _check_tensors(path, tensors, card.architecture)
    return Weights(card, tensors)


def find_weights(name_or_path: str | Path) -> Path:
    """The file of bundled weights ("superpoint") or the given path.

    Raises:
        InputError: neither a bundled name nor an existing file.
    """
    bundled = BUNDLED / f"{name_or_path}.safetensors"
    if str(name_or_path) in bundled_names():
        return bundled
    path = Path(name_or_path)
    if not path.is_file():
        raise InputError(f"{path}: no such weights file; bundled: {', '.join(bundled_names()) or 'none'}")
    return path


def bundled_names() -> list[str]:
    """Names of the weights that come with the package."""
    return sorted(path.stem for path in BUNDLED.glob("*.safetensors"))


def _counter(name: str) -> bool:
    return name.endswith("num_batches_tracked")


def _check_tensors(path: Path, tensors: Mapping[str, Float32], architecture: Architecture) -> None:
    expected = expected_shapes(architecture)
    for name in sorted(expected.keys() ^ tensors.keys()):
        state = "is missing" if name in expected else "does not belong there"
        raise InputError(f"{path}: tensor {name} {state}; the weights are of another architecture than their card")
    for name, values in tensors.items():
        if values.shape != expected[name]:
            raise InputError(
                f"{path}: tensor {name} has shape {values.shape}, {architecture.name} needs {expected[name]}; "
                "the weights are of another architecture than their card"
            )
        if not np.isfinite(values).all():
            raise InputError(f"{path}: tensor {name} has values that are not finite; train or fetch it again")
