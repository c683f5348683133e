"""Our weights in the layouts of public SuperPoint implementations, which load them strictly and compute the same.

`original`: the release of DeTone et al. and the programs after it (SuperGlue, LightGlue, hloc, pySLAM): convolutions
alone. `rpautrat`: batch norm after each ReLU, here one that does nothing where ours was folded. `transformers`: a
folder for `SuperPointForKeypointDetection.from_pretrained`. The first two have fixed widths: a narrower network gets
channels that are always zero, so its descriptors end in zeros, which changes neither length nor distance. None has a
stability head.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from improvo import config, files
from improvo.errors import InputError, OutputError, imported
from improvo.frontend.architecture import Architecture
from improvo.frontend.channel_pruning import with_dead_channels
from improvo.frontend.importing import LAYOUTS, Layout
from improvo.frontend.settings import NetworkSettings
from improvo.frontend.weights_files import Weights

NAMES = ("original", "rpautrat", "transformers")
FILES = (".pth", ".pt", ".safetensors")  # of the layouts that are a file
CARD = "improvo-model-card.json"  # in the folder of the layout transformers

_ORIGINAL = next(layout for layout in LAYOUTS if layout.normalisation == "none")
_RPAUTRAT = next(layout for layout in LAYOUTS if layout.normalisation == "after_relu")
_STANDARD = Architecture("superpoint", stability=False)  # the widths that the consumers of a file have

Tensors = dict[str, NDArray[Any]]


def export_weights(weights: Weights, name: str, target: Path) -> None:
    """Write weights in the layout `name`, and the model card beside them.

    Args:
        weights: of any of our networks; a stability head is left out.
        name: one of `NAMES`.
        target: a `.pth` file, which needs torch, or a `.safetensors` file; a new folder for `transformers`.

    Raises:
        InputError: a network that the layout cannot hold.
        MissingExtraError: a `.pth` file without torch.
        OutputError: another suffix, or the target cannot be written.
    """
    card = {**config.to_dict(weights.card), "layout": name, "left_out": left_out(weights)}
    tensors = layout_tensors(weights, name)
    if name == "transformers":
        files.make_output_folder(target, "weights export")
        _write_tensors(target / "model.safetensors", tensors, {"format": "pt"})
        files.write_json(target / "config.json", _transformers_config(weights.architecture))
        files.write_json(target / "preprocessor_config.json", _PREPROCESSING)
        files.write_json(target / CARD, card)
        return
    if target.suffix not in FILES:
        raise OutputError(f"{target}: the layout {name} is a file; name it .pth or .safetensors")
    _write_tensors(target, tensors, {})
    files.write_json(target.with_suffix(".json"), card)


def layout_tensors(weights: Weights, name: str) -> Tensors:
    """Tensors under the names of a layout, float32 (batch-norm counters int64).

    Raises:
        InputError: widths beyond the layout's, or batch norm after the ReLU, which only `rpautrat` has.
    """
    architecture = weights.architecture
    if architecture.normalisation == "after_relu" and name != "rpautrat":
        raise InputError(
            f"{architecture.name}: its batch norm follows the ReLU, and cannot be folded; --layout rpautrat holds it"
        )
    if name == "transformers":
        _check_pattern(architecture)
        return _renamed(_folded(weights), _transformers_names())
    _check_widths(architecture, name)
    if name == "original":
        return _renamed(with_dead_channels(_folded(weights), _plain(_STANDARD)), _convolutions(_ORIGINAL))
    return _with_norms(weights)


def left_out(weights: Weights) -> list[str]:
    """What our network has and the layouts have not."""
    return ["stability head"] if weights.architecture.stability else []


def _plain(architecture: Architecture) -> Architecture:
    return replace(architecture.without_normalisation(), stability=False)


def _folded(weights: Weights) -> dict[str, NDArray[np.float32]]:
    """Convolutions alone, under our names, without a stability head."""
    found = {}
    for layer in weights.folded():
        name = layer.convolution.name
        if not name.startswith("stability"):
            found[f"{name}.convolution.weight"], found[f"{name}.convolution.bias"] = layer.weight, layer.bias
    return found


def _with_norms(weights: Weights) -> Tensors:
    """The layout `rpautrat`: every convolution with a batch norm, the heads' last ones too."""
    ours = weights.tensors if weights.architecture.normalisation == "after_relu" else _folded(weights)
    normalisation = weights.architecture.normalisation if ours is weights.tensors else "none"
    wide = with_dead_channels(ours, replace(_STANDARD, normalisation=normalisation))
    found: Tensors = {}
    for layer, (convolution, norm) in _RPAUTRAT.names.items():
        bias = wide[f"{layer}.convolution.bias"]
        found[f"{convolution}.weight"], found[f"{convolution}.bias"] = wide[f"{layer}.convolution.weight"], bias
        own = {part: wide.get(f"{layer}.norm.{part}") for part in ("weight", "bias", "running_mean", "running_var")}
        if own["weight"] is None:
            own = {
                "weight": np.ones_like(bias),
                "bias": np.zeros_like(bias),
                "running_mean": np.zeros_like(bias),
                "running_var": np.full_like(bias, 1 - _RPAUTRAT.norm_epsilon),  # they add theirs: 1
            }
        elif weights.architecture.norm_epsilon != _RPAUTRAT.norm_epsilon:
            variance = np.asarray(own["running_var"], np.float64)
            ratio = (variance + _RPAUTRAT.norm_epsilon) / (variance + weights.architecture.norm_epsilon)
            own["weight"] = (own["weight"] * np.sqrt(ratio)).astype(np.float32)
        found |= {f"{norm}.{part}": np.asarray(values) for part, values in own.items()}
        found[f"{norm}.num_batches_tracked"] = np.zeros((), np.int64)
    return found


def _convolutions(layout: Layout) -> dict[str, str]:
    return {layer: convolution for layer, (convolution, _) in layout.names.items()}


def _transformers_names() -> dict[str, str]:
    names = {f"encoder.{2 * i + j}": f"encoder.conv_blocks.{i}.conv_{'ab'[j]}" for i in range(4) for j in (0, 1)}
    heads = {"detector": "keypoint_decoder.conv_score", "descriptor": "descriptor_decoder.conv_descriptor"}
    return names | {f"{ours}.{j}": f"{theirs}_{'ab'[j]}" for ours, theirs in heads.items() for j in (0, 1)}


def _renamed(tensors: Mapping[str, NDArray[Any]], names: Mapping[str, str]) -> Tensors:
    """Our `LAYER.convolution.PART` as `THEIRS.PART`."""
    found: Tensors = {}
    for name, values in tensors.items():
        layer, _, part = name.partition(".convolution.")
        found[f"{names[layer]}.{part}"] = values
    return found


def _check_widths(architecture: Architecture, name: str) -> None:
    widths = (*architecture.encoder, architecture.head, architecture.descriptor)
    if any(own > most for own, most in zip(widths, (*_STANDARD.encoder, 256, 256), strict=True)):
        raise InputError(
            f"{architecture.name}: its widths {'-'.join(map(str, widths))} exceed those of the layout {name}, "
            "64-64-64-64-128-128-128-128-256-256; --layout transformers holds other widths"
        )


def _check_pattern(architecture: Architecture) -> None:
    widths = architecture.encoder
    if widths[0::2] != widths[1::2]:
        raise InputError(
            f"{architecture.name}: the layout transformers has one width for each pair of convolutions, not "
            f"{'-'.join(map(str, widths))}; --layout original may hold it"
        )


_PREPROCESSING = {
    "image_processor_type": "SuperPointImageProcessor",
    "do_resize": False,
    "do_rescale": True,
    "rescale_factor": 1 / 255,
    "do_grayscale": True,
}


def _transformers_config(architecture: Architecture) -> dict[str, Any]:
    settings = NetworkSettings()
    return {
        "architectures": ["SuperPointForKeypointDetection"],
        "model_type": "superpoint",
        "encoder_hidden_sizes": list(architecture.encoder[::2]),
        "decoder_hidden_size": architecture.head,
        "keypoint_decoder_dim": 65,
        "descriptor_decoder_dim": architecture.descriptor,
        "keypoint_threshold": settings.threshold,
        "max_keypoints": settings.max_keypoints,
        "nms_radius": settings.nms_radius,
        "border_removal_distance": settings.border,
    }


def _write_tensors(path: Path, tensors: Tensors, metadata: dict[str, str]) -> None:
    kept = {name: np.ascontiguousarray(values) for name, values in sorted(tensors.items())}
    if path.suffix == ".safetensors":
        from safetensors.numpy import save

        with files.written_atomically(path) as temporary:
            temporary.write_bytes(save(kept, metadata=metadata))
        return
    torch = imported("torch", "writing .pth, unlike .safetensors,", "train")
    with files.written_atomically(path) as temporary:
        stream = io.BytesIO()  # into a file, torch would write the file's name, which is another one each time
        torch.save({name: torch.from_numpy(values.copy()) for name, values in kept.items()}, stream)
        temporary.write_bytes(stream.getvalue())
